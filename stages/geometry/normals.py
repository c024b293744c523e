"""Normals of the map's points: of the plane through the points around each, towards where it was seen from.

Points come ordered by voxel, x slowest, so the points of a column of voxels follow each other. For each of the columns
around, a pointer moves along as the point does: neighbours are found without a search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel

I8 = NDArray[np.int64]
F8 = NDArray[np.float64]
I1 = NDArray[np.int8]

REACH = 2
"""Voxels to each side whose points count."""
LEAST_POINTS = 5
FLAT = 0.25
"""A surface is thinner than half of its width: the least variance is below this share of the middle one."""


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
    normal = np.empty(3)
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
        share = 1.0 / count
        if not _thinnest(
            xx - sx * sx * share, xy - sx * sy * share, xz - sx * sz * share, yy - sy * sy * share,
            yz - sy * sz * share, zz - sz * sz * share, normal,
        ):  # fmt: skip
            continue
        towards = normal[0] * view[n, 0] + normal[1] * view[n, 1] + normal[2] * view[n, 2]
        scale = 127.0 if towards >= 0.0 else -127.0
        for k in range(3):
            out[n, k] = np.rint(scale * normal[k])
    return out


@kernel
def _thinnest(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, normal: F8) -> bool:
    """Writes the unit eigenvector of the least eigenvalue into `normal` (3,), if that is the normal of a surface.

    Eigenvalues by trigonometry (Smith, Communications of the ACM 4, 1961); the eigenvector is orthogonal to the rows of
    S - least I, hence along their longest cross product.
    """
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    p = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if p <= 0.0:
        return False
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(min(max(0.5 * det / (p * p * p), -1.0), 1.0)) / 3.0
    most = mean + 2.0 * p * np.cos(angle)
    least = mean + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    if least >= FLAT * (3.0 * mean - most - least):
        return False
    a, b, c = xx - least, yy - least, zz - least
    longest = 0.0
    for k in range(3):
        if k == 0:
            u, v, w = b * c - yz * yz, xz * yz - xy * c, xy * yz - xz * b
        elif k == 1:
            u, v, w = yz * xz - xy * c, a * c - xz * xz, xz * xy - a * yz
        else:
            u, v, w = xy * yz - b * xz, xy * xz - a * yz, a * b - xy * xy
        square = u * u + v * v + w * w
        if square > longest:
            longest = square
            normal[0], normal[1], normal[2] = u, v, w
    if longest <= 0.0:
        return False
    scale = 1.0 / np.sqrt(longest)
    for k in range(3):
        normal[k] *= scale
    return True
