"""Sparse Cholesky factorisation in blocks of 6 by 6: one block row per pose.

What a pose graph needs of linear algebra: the step, and those blocks of the inverse that stand where the factor has
entries (Takahashi, Fagan, Chen 1973; Erisman, Tinney 1975): every pose's marginal covariance and the covariance between
the two ends of every measurement. Both take time linear in the number of blocks for a chain with a few loops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
B = 6


@dataclass(frozen=True)
class Pattern:
    """Where the factor of a symmetric block matrix (n, n) has entries.

    Blocks are in the order of elimination: `place[k]` is where pose k went. Column c holds its diagonal block and the
    rows `row[start[c]:start[c + 1]]` below it, in rising order.
    """

    place: I8
    start: I8
    row: I8

    @property
    def n(self) -> int:
        return len(self.place)

    def positions(self, i: I8, j: I8) -> I8:
        """Position in `row` of the blocks between poses i and j (m,), which differ.

        Raises
        ------
        KeyError : two poses that share no entry.
        """
        a, b = self.place[i], self.place[j]
        found = _positions(self.start, self.row, np.minimum(a, b), np.maximum(a, b))
        if len(found) and found.min() < 0:
            raise KeyError("no entry between two poses")
        return np.asarray(found)


@dataclass(frozen=True)
class Blocks:
    """A symmetric block matrix, or its factor: diagonal blocks (n, 6, 6) and those below (m, 6, 6)."""

    diagonal: F8
    below: F8


def pattern(n: int, i: I8, j: I8) -> Pattern:
    """Order of elimination by minimum degree and fill of a matrix with blocks between poses i and j (m,)."""
    from scipy.sparse import coo_matrix, identity
    from scipy.sparse.linalg import splu

    pairs = np.unique(np.column_stack((np.minimum(i, j), np.maximum(i, j))), axis=0).astype(np.int64)
    graph = coo_matrix((np.full(len(pairs), -1.0), (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsc()
    degree = np.bincount(pairs.ravel(), minlength=n) + 1.0
    whole = (graph + graph.T + identity(n, format="csc").multiply(degree)).tocsc()
    ordered = splu(whole, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    place = ordered.perm_c.astype(np.int64)
    a, b = place[pairs[:, 0]], place[pairs[:, 1]]
    low, high = np.minimum(a, b), np.maximum(a, b)
    by_column = np.lexsort((high, low))
    first = np.searchsorted(low[by_column], np.arange(n + 1)).astype(np.int64)
    start, row = _fill(n, first, high[by_column].astype(np.int64))
    return Pattern(place, start, row)


def assembled(
    p: Pattern, i: I8, j: I8, between: I8, A_i: F8, A_j: F8, residual: F8, weight: F8
) -> tuple[Blocks, F8]:
    """Normal equations A^T W A and -A^T W r (n, 6), in order of elimination.

    i, j : (m,) poses of each row of blocks, j is -1 for none; between : (m,) position of the block between them;
    A_i, A_j : (m, 6, 6) whitened Jacobians; residual : (m, 6) whitened; weight : (m,).
    """
    matrix = Blocks(np.zeros((p.n, B, B)), np.zeros((len(p.row), B, B)))
    right = np.zeros((p.n, B))
    _assemble(p.place, i, j, between, A_i, A_j, residual, weight, matrix.diagonal, matrix.below, right)
    return matrix, right


def factorised(p: Pattern, matrix: Blocks) -> Blocks:
    """Lower Cholesky factor.

    Raises
    ------
    FloatingPointError : the matrix is not positive definite.
    """
    factor = Blocks(matrix.diagonal.copy(), matrix.below.copy())
    if not _factorise(p.start, p.row, factor.diagonal, factor.below):
        raise FloatingPointError("the matrix is not positive definite")
    return factor


def solved(p: Pattern, factor: Blocks, right: F8) -> F8:
    """Solution (n, 6) for a right side (n, 6) in order of elimination; the result is in the order of poses."""
    x = right.copy()
    _substitute(p.start, p.row, factor.diagonal, factor.below, x)
    _substitute_back(p.start, p.row, factor.diagonal, factor.below, x)
    return np.asarray(x[p.place])


def inverse_blocks(p: Pattern, factor: Blocks) -> Blocks:
    """Blocks of the inverse where the factor has entries; `below` holds block (row, column)."""
    found = Blocks(np.zeros_like(factor.diagonal), np.zeros_like(factor.below))
    _invert(p.start, p.row, factor.diagonal, factor.below, found.diagonal, found.below)
    return found


@kernel
def _fill(n: int, first: I8, given: I8) -> tuple[I8, I8]:
    """Structure of the factor: a column's rows are its own and those of the columns whose first row it is."""
    start = np.zeros(n + 1, np.int64)
    row = np.empty(max(4 * len(given), 16), np.int64)
    child, sibling = np.full(n, -1), np.full(n, -1)
    mark = np.full(n, -1)
    count = 0
    for c in range(n):
        start[c] = count
        mark[c] = c
        for k in range(first[c], first[c + 1]):
            if mark[given[k]] != c:
                mark[given[k]] = c
                if count == len(row):
                    row = np.concatenate((row, np.empty(len(row), np.int64)))
                row[count] = given[k]
                count += 1
        d = child[c]
        while d >= 0:
            for k in range(start[d], start[d + 1]):
                if mark[row[k]] != c:
                    mark[row[k]] = c
                    if count == len(row):
                        row = np.concatenate((row, np.empty(len(row), np.int64)))
                    row[count] = row[k]
                    count += 1
            d = sibling[d]
        row[start[c] : count] = np.sort(row[start[c] : count])
        start[c + 1] = count
        if count > start[c]:
            parent = row[start[c]]
            sibling[c] = child[parent]
            child[parent] = c
    return start, row[:count].copy()


@kernel
def _positions(start: I8, row: I8, column: I8, wanted: I8) -> I8:
    out = np.empty(len(column), np.int64)
    for k in range(len(column)):
        c = column[k]
        at = start[c] + np.searchsorted(row[start[c] : start[c + 1]], wanted[k])
        out[k] = at if at < start[c + 1] and row[at] == wanted[k] else -1
    return out


@kernel
def _assemble(
    place: I8, i: I8, j: I8, between: I8, A_i: F8, A_j: F8, residual: F8, weight: F8,
    diagonal: F8, below: F8, right: F8,
) -> None:  # fmt: skip
    for m in range(len(i)):
        w = weight[m]
        if w == 0.0:
            continue
        a = place[i[m]]
        _add_square(A_i[m], A_i[m], w, diagonal[a])
        _subtract_right(A_i[m], residual[m], w, right[a])
        if j[m] >= 0:
            b = place[j[m]]
            _add_square(A_j[m], A_j[m], w, diagonal[b])
            _subtract_right(A_j[m], residual[m], w, right[b])
            if a > b:
                _add_square(A_i[m], A_j[m], w, below[between[m]])
            else:
                _add_square(A_j[m], A_i[m], w, below[between[m]])


@kernel
def _add_square(A: F8, C: F8, w: float, out: F8) -> None:
    """out += w A^T C."""
    for k in range(6):
        for r in range(6):
            a = w * A[k, r]
            for c in range(6):
                out[r, c] += a * C[k, c]


@kernel
def _subtract_right(A: F8, residual: F8, w: float, out: F8) -> None:
    for r in range(6):
        total = 0.0
        for k in range(6):
            total += A[k, r] * residual[k]
        out[r] -= w * total


@kernel
def _factorise(start: I8, row: I8, diagonal: F8, below: F8) -> bool:
    """In place, column by column, each handing its update on to the columns of its rows at once."""
    n = len(diagonal)
    turned = np.empty((6, 6))
    for c in range(n):
        if not _cholesky(diagonal[c]):
            return False
        L = diagonal[c]
        for k in range(start[c], start[c + 1]):
            _divide(below[k], L)
        for s in range(start[c], start[c + 1]):
            target = row[s]
            _transpose(below[s], turned)
            _subtract_plain(below[s], turned, diagonal[target])
            at = start[target]
            for k in range(s + 1, start[c + 1]):
                while row[at] != row[k]:
                    at += 1
                _subtract_plain(below[k], turned, below[at])
    return True


@kernel
def _cholesky(A: F8) -> bool:
    """Of one block, in place; what stands above the diagonal becomes zero."""
    for c in range(6):
        total = A[c, c]
        for k in range(c):
            total -= A[c, k] * A[c, k]
        if not total > 1e-13 * abs(A[c, c]):
            return False
        A[c, c] = np.sqrt(total)
        for r in range(c + 1, 6):
            total = A[r, c]
            for k in range(c):
                total -= A[r, k] * A[c, k]
            A[r, c] = total / A[c, c]
            A[c, r] = 0.0
    return True


@kernel
def _divide(A: F8, L: F8) -> None:
    """A <- A L^-T."""
    for r in range(6):
        for c in range(6):
            total = A[r, c]
            for k in range(c):
                total -= A[r, k] * L[c, k]
            A[r, c] = total / L[c, c]


@kernel
def _transpose(A: F8, out: F8) -> None:
    for r in range(6):
        for c in range(6):
            out[c, r] = A[r, c]


@kernel
def _substitute(start: I8, row: I8, diagonal: F8, below: F8, x: F8) -> None:
    """L x <- x, in place."""
    n = len(diagonal)
    for c in range(n):
        for r in range(6):
            total = x[c, r]
            for k in range(r):
                total -= diagonal[c, r, k] * x[c, k]
            x[c, r] = total / diagonal[c, r, r]
        for s in range(start[c], start[c + 1]):
            for r in range(6):
                total = 0.0
                for k in range(6):
                    total += below[s, r, k] * x[c, k]
                x[row[s], r] -= total


@kernel
def _substitute_back(start: I8, row: I8, diagonal: F8, below: F8, x: F8) -> None:
    """L^T x <- x, in place."""
    n = len(diagonal)
    for c in range(n - 1, -1, -1):
        for s in range(start[c], start[c + 1]):
            for r in range(6):
                total = 0.0
                for k in range(6):
                    total += below[s, k, r] * x[row[s], k]
                x[c, r] -= total
        for r in range(5, -1, -1):
            total = x[c, r]
            for k in range(r + 1, 6):
                total -= diagonal[c, k, r] * x[c, k]
            x[c, r] = total / diagonal[c, r, r]


@kernel
def _invert(start: I8, row: I8, diagonal: F8, below: F8, Z_diagonal: F8, Z_below: F8) -> None:
    """From the last column back: Z_rc = -sum_k Z_rk U_kc, Z_cc = (L L^T)^-1 - sum_k U_kc^T Z_kc, with U = L_kc L_cc^-1."""
    n = len(diagonal)
    longest = 0
    for c in range(n):
        longest = max(longest, start[c + 1] - start[c])
    U = np.empty((longest, 6, 6))
    inverse = np.zeros((6, 6))
    for c in range(n - 1, -1, -1):
        _invert_lower(diagonal[c], inverse)
        first, m = start[c], start[c + 1] - start[c]
        for k in range(m):
            _product(below[first + k], inverse, U[k])
        for s in range(m):
            target = row[first + s]
            _subtract_plain(Z_diagonal[target], U[s], Z_below[first + s])
            at = start[target]
            for k in range(s + 1, m):
                while row[at] != row[first + k]:
                    at += 1
                _subtract_plain(Z_below[at], U[s], Z_below[first + k])
                _subtract_turned(Z_below[at], U[k], Z_below[first + s])
        _add_square(inverse, inverse, 1.0, Z_diagonal[c])
        for k in range(m):
            _subtract_turned(U[k], Z_below[first + k], Z_diagonal[c])


@kernel
def _invert_lower(L: F8, out: F8) -> None:
    for c in range(6):
        out[c, c] = 1.0 / L[c, c]
        for r in range(c + 1, 6):
            total = 0.0
            for k in range(c, r):
                total -= L[r, k] * out[k, c]
            out[r, c] = total / L[r, r]


@kernel
def _product(A: F8, C: F8, out: F8) -> None:
    out[:] = 0.0
    for r in range(6):
        for k in range(6):
            for c in range(6):
                out[r, c] += A[r, k] * C[k, c]


# The innermost loop of these runs along a row, so that it compiles to vector instructions without reordering any sum.


@kernel
def _subtract_plain(A: F8, C: F8, out: F8) -> None:
    """out -= A C."""
    for r in range(6):
        for k in range(6):
            for c in range(6):
                out[r, c] -= A[r, k] * C[k, c]


@kernel
def _subtract_turned(A: F8, C: F8, out: F8) -> None:
    """out -= A^T C."""
    for k in range(6):
        for r in range(6):
            for c in range(6):
                out[r, c] -= A[k, r] * C[k, c]
