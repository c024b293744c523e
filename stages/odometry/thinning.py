"""What odometry keeps of a scan: static points, thinned twice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, PointClass, ScanLabels
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.registration import normals_at
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import EMPTY, Float, Int, downsample, find_slot, key_of, table_length
from scanloom.stages.odometry.settings import Settings

LEAST_TO_JUDGE, DENSE_POINTS = 500, 8000
"""Points of a thinned scan: fewer say nothing of the sensor; a sensor near walls has surfaces with fewer, too."""
DENSE_REACH_M = 0.7
USED = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)
USED_CLASS = np.isin(np.arange(256), USED)


@dataclass(frozen=True)
class ThinScan:
    """Points in the LiDAR frame, m: `fine` (n, 3) for the map, `coarse` (m, 3) of these for registration."""

    scan_index: int
    stamp_ns: int
    fine: F8
    coarse: F8
    voxel_size_m: float
    """Of the map that suits these scans."""
    normals: F8 | None = None
    """(m, 3) of the surfaces through `coarse`, zero where there is none; only for plane to plane."""


class Thinner:
    """Thins the scans of a session alike. How finely the first scan tells, the one with enough points to judge by."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._dense: bool | None = None

    def thin(self, scan: DeskewedScan, labels: ScanLabels) -> ThinScan:
        """Of the points that may be part of the static world, the first in each voxel."""
        chosen = self._settings
        fine = _fine(scan, labels, chosen.dense_map_spacing_m if self._dense else chosen.map_spacing_m)
        if self._dense is None and len(fine) >= LEAST_TO_JUDGE:
            share = surface_share(fine, DENSE_REACH_M) if len(fine) >= DENSE_POINTS else 0.0
            self._dense = len(fine) >= DENSE_POINTS and share >= chosen.dense_share
            if self._dense:
                return self.thin(scan, labels)
        voxel_m, source_m = chosen.voxel_size_m, chosen.source_voxel_m
        if self._dense:
            voxel_m, source_m = chosen.dense_voxel_size_m, chosen.dense_source_voxel_m
        coarse = fine[downsample(fine, source_m)]
        planes = chosen.residual == "plane_to_plane"
        normals = normals_at(coarse, fine, voxel_m) if planes else None
        return ThinScan(scan.scan_index, scan.reference_ns, fine, coarse, voxel_m, normals)


def _fine(scan: DeskewedScan, labels: ScanLabels, spacing_m: float) -> F8:
    fine: F8 = _first_used(
        scan.x_m, scan.y_m, scan.z_m, labels.class_, USED_CLASS, 1.0 / spacing_m, table_length(len(scan))
    )
    return fine


def surface_share(points: F8, voxel_m: float) -> float:
    """Share of the points (n, 3), m, one a voxel, that lie on a surface within this reach."""
    some = points[downsample(points, voxel_m)]
    return float(normals_at(some, points, voxel_m).any(axis=1).mean())


@kernel
def _first_used(
    xs: NDArray[np.float32], ys: NDArray[np.float32], zs: NDArray[np.float32], classes: NDArray[np.uint8],
    used: NDArray[np.bool_], per_m: Float, length: Int,
) -> F8:  # fmt: skip
    """First point of every voxel among those of a used class, in order; what is not finite is left out."""
    keys = np.full(length, EMPTY, np.int64)
    out = np.empty((len(xs), 3))
    found = 0
    for n in range(len(xs)):
        if not used[classes[n]]:
            continue
        x, y, z = float(xs[n]), float(ys[n]), float(zs[n])
        key = key_of(x, y, z, per_m)
        if key == EMPTY:
            continue
        slot = find_slot(keys, key)
        if keys[slot] == EMPTY:
            keys[slot] = key
            out[found, 0], out[found, 1], out[found, 2] = x, y, z
            found += 1
    return out[:found].copy()
