"""Normals of the map's points: of the plane through the points around each, towards where it was seen from.

Points come ordered by voxel, x slowest, so the points of a column of voxels follow each other. For each of the columns
around, a pointer moves along as the point does: neighbours are found without a search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.voxels import Int

I8 = NDArray[np.int64]
F8 = NDArray[np.float64]
I1 = NDArray[np.int8]

REACH = 2
"""Voxels to each side whose points count."""
LEAST_POINTS = 5
FLAT = 0.25
"""A surface is thinner than half of its width: the least variance is below this share of the middle one."""
SWEEPS = 6
"""Of Jacobi rotations; three by three is done to machine precision after five."""


def normals(key: I8, x_m: F8, y_m: F8, z_m: F8, view: I1, step_x: int, step_y: int, far_m: float) -> I1:
    """Normals (n, 3) times 127, zeros where there is no surface.

    key : (n,) number of the voxel, ascending; `step_x`, `step_y` lead to the next voxel along x and y, 1 along z.
    x_m, y_m, z_m : (n,) points, m.
    view : (n, 3) direction to the sensor, of any length.
    far_m : points farther off belong to the other side of a full tile, whose numbers go round.
    """
    out: I1 = _normals(key, x_m, y_m, z_m, view, step_x, step_y, far_m)
    return out


@kernel
def _normals(key: I8, x: F8, y: F8, z: F8, view: I1, step_x: int, step_y: int, far_m: float) -> I1:
    out = np.zeros((len(key), 3), np.int8)
    width = 2 * REACH + 1
    first = np.zeros(width * width, np.int64)
    S, V = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(key)):
        count, sx, sy, sz = 0, 0.0, 0.0, 0.0
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for column in range(width * width):
            middle = key[n] + (column // width - REACH) * step_x + (column % width - REACH) * step_y
            at = first[column]
            while at < len(key) and key[at] < middle - REACH:
                at += 1
            first[column] = at
            while at < len(key) and key[at] <= middle + REACH:
                dx, dy, dz = x[at] - x[n], y[at] - y[n], z[at] - z[n]
                at += 1
                if abs(dx) + abs(dy) > far_m:
                    continue
                count, sx, sy, sz = count + 1, sx + dx, sy + dy, sz + dz
                xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
                yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
        if count < LEAST_POINTS:
            continue
        S[0, 0], S[0, 1], S[0, 2] = xx - sx * sx / count, xy - sx * sy / count, xz - sx * sz / count
        S[1, 1], S[1, 2], S[2, 2] = yy - sy * sy / count, yz - sy * sz / count, zz - sz * sz / count
        S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
        thin = _thinnest(S, V)
        if thin < 0:
            continue
        towards = V[0, thin] * view[n, 0] + V[1, thin] * view[n, 1] + V[2, thin] * view[n, 2]
        scale = 127.0 if towards >= 0.0 else -127.0
        for k in range(3):
            out[n, k] = np.rint(scale * V[k, thin])
    return out


@kernel
def _thinnest(S: F8, V: F8) -> Int:
    """Column of V, the eigenvectors of S (3, 3), that is normal to a surface; -1 where there is none. Jacobi's method."""
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        _rotate(S, V, 0, 1)
        _rotate(S, V, 0, 2)
        _rotate(S, V, 1, 2)
    thin = 0
    for k in range(1, 3):
        if S[k, k] < S[thin, thin]:
            thin = k
    middle = np.inf
    for k in range(3):
        if k != thin:
            middle = min(middle, S[k, k])
    return thin if S[thin, thin] < FLAT * middle else -1


@kernel
def _rotate(S: F8, V: F8, p: int, q: int) -> None:
    """Turns the axes p, q so that S[p, q] vanishes. Golub and Van Loan, section 8.5."""
    if S[p, q] == 0.0:
        return
    theta = (S[q, q] - S[p, p]) / (2.0 * S[p, q])
    t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
    c = 1.0 / np.sqrt(t * t + 1.0)
    s = t * c
    for k in range(3):
        S[k, p], S[k, q] = c * S[k, p] - s * S[k, q], s * S[k, p] + c * S[k, q]
    for k in range(3):
        S[p, k], S[q, k] = c * S[p, k] - s * S[q, k], s * S[p, k] + c * S[q, k]
        V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]
