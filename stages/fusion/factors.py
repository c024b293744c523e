"""Factors of the pose graph as plain data, their residuals, and their rows in the product."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.se3 import F8, inverse, se3_log

USED = "used"
BETWEEN, PRIOR, POSITION, UP = range(4)
SHAPE = {
    "odometry": BETWEEN, "wheel": BETWEEN, "loop": BETWEEN, "prior": PRIOR, "base": PRIOR, "gnss": POSITION, "gravity": UP,
}  # fmt: skip
"""What a factor of a kind is to the solver."""
COMPONENTS = {BETWEEN: slice(0, 6), PRIOR: slice(0, 6), POSITION: slice(3, 6), UP: slice(0, 2)}
"""Which rows of its covariance count."""
DOUBTED = ("loop", "gnss")


@dataclass
class Factor:
    """One measurement between nodes `i` and `j` (j is -1 for a measurement of one node).

    kind `odometry`, `wheel`, `loop`, `prior`, `base`: `measurement` is the pose of j in i, or of i itself;
    kind `gnss`: position (3,) of the antenna in the last column, `arm_m` the antenna in the frame of node i;
    kind `gravity`: up (3,) in the frame of node i in the last column.
    A direction that was not measured at all has an infinite variance.
    """

    kind: str
    i: int
    j: int
    measurement: F8
    covariance: F8
    verdict: str = ""
    """Empty for a factor that is in use, else why it is not."""
    arm_m: F8 = field(default_factory=lambda: np.zeros(3))
    weight: float = 1.0

    @property
    def doubted(self) -> bool:
        """The solver may switch it off."""
        return self.kind in DOUBTED


def whitened_norms(factors: Sequence[Factor], T: F8) -> F8:
    """Norm (m,) of each factor's whitened residual at nodes T (n, 4, 4); NaN where there is no measurement."""
    out = np.full(len(factors), np.nan)
    shapes = np.array([SHAPE[f.kind] for f in factors], np.int64)
    for shape, residuals in _RESIDUALS.items():
        rows = np.flatnonzero(shapes == shape)
        if len(rows):
            chosen = [factors[int(k)] for k in rows]
            block = COMPONENTS[shape]
            covariance, measured = certain(np.array([f.covariance for f in chosen])[:, block, block])
            error = np.where(measured, residuals(chosen, T), 0.0)
            with np.errstate(invalid="ignore"):
                square = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
                out[rows] = np.sqrt(np.maximum(square, 0.0))
    return out


def certain(covariance: F8) -> tuple[F8, NDArray[np.bool_]]:
    """Covariances (m, k, k) with a unit variance of their own for directions not measured, and which are (m, k)."""
    measured = ~np.isinf(np.diagonal(covariance, axis1=1, axis2=2))
    both = measured[:, :, None] & measured[:, None, :]
    return np.where(both, covariance, np.eye(covariance.shape[1])), np.asarray(measured)


def _between(factors: Sequence[Factor], T: F8) -> F8:
    i, j = np.array([f.i for f in factors]), np.array([f.j for f in factors])
    measured = np.array([f.measurement for f in factors])
    return se3_log(inverse(measured) @ inverse(T[i]) @ T[j])


def _prior(factors: Sequence[Factor], T: F8) -> F8:
    measured = np.array([f.measurement for f in factors])
    return se3_log(inverse(measured) @ T[[f.i for f in factors]])


def _gnss(factors: Sequence[Factor], T: F8) -> F8:
    at = T[[f.i for f in factors]]
    arm = np.array([f.arm_m for f in factors])
    position = np.einsum("nij,nj->ni", at[:, :3, :3], arm) + at[:, :3, 3]
    return np.asarray(position - np.array([f.measurement[:3, 3] for f in factors]))


def _gravity(factors: Sequence[Factor], T: F8) -> F8:
    up = np.array([f.measurement[:3, 3] for f in factors])
    world = np.einsum("nij,nj->ni", T[[f.i for f in factors], :3, :3], up)
    return np.column_stack((world[:, 1], -world[:, 0]))


_RESIDUALS: dict[int, Callable[[Sequence[Factor], F8], F8]] = {
    BETWEEN: _between,
    PRIOR: _prior,
    POSITION: _gnss,
    UP: _gravity,
}


def position_residuals(factors: Sequence[Factor], T: F8) -> F8:
    """Antenna minus fix (m, 3) of each factor of kind `gnss` at nodes T (n, 4, 4), m; NaN for the others."""
    out = np.full((len(factors), 3), np.nan)
    rows = np.array([k for k, f in enumerate(factors) if f.kind == "gnss"], np.int64)
    if len(rows):
        out[rows] = _gnss([factors[k] for k in rows], T)
    return out


def graph_table(
    factors: Sequence[Factor], before: F8, after: F8, residual_m: F8, key: Callable[[int], str]
) -> Graph:
    """One row per factor, used or not. `key` names a node."""
    return Graph(
        kind=np.array([f.kind for f in factors], object),
        key_i=np.array([key(f.i) for f in factors], object),
        key_j=np.array([key(f.j) if f.j >= 0 else "" for f in factors], object),
        measurement=np.array([f.measurement for f in factors], float).reshape(-1, 4, 4),
        covariance=np.array([f.covariance for f in factors], float).reshape(-1, 6, 6),
        residual_before=before,
        residual_after=after,
        residual_m=residual_m,
        weight=np.array([0.0 if f.verdict else f.weight for f in factors], float),
        verdict=np.array([f.verdict or USED for f in factors], object),
    )
