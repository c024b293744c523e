"""Points of a map, and what the simulator knows of the LiDAR points that each of them is the mean of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.pipeline.run import Result
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, TrueLabels, TruePoints
from scanloom.schemas.session import TruthLog
from scanloom.schemas.simulated import TrueColours, TruePaint
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Poses, Truth
from scanloom.stages.colour.surroundings import ground_of
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8, transform
from scanloom.stages.geometry.srgb import LINEAR

_SHIFT, _HALF = 21, 1 << 20
I8 = NDArray[np.int64]


@dataclass(frozen=True)
class Known:
    """Points (n,) of a map, tile by tile, with their truth."""

    names: tuple[str, ...]
    """Of the tiles."""
    tile: I8
    """Number of the tile each is from."""
    voxel: I8
    normal: F8
    """(n, 3) unit, zeros where there is no surface."""
    count: I8
    """LiDAR points in the voxel that entered the map."""
    place: F8
    """(n, 3) where the mean of these points truly is, m."""
    albedo: F8
    """(n, 3) their mean share of light that comes back."""
    lit: F8
    """Share of them that the sun shines on."""
    static: F8
    """Share of them that truly is ground or stands."""
    ground: F8
    """Share that truly is ground."""


def known(result: Result) -> Known:
    """Everything of one drive; points that truth says nothing of are left out."""
    names, tile, voxel, xyz, normal, voxel_m = _points(result)
    keys = _keys(xyz, voxel_m)
    order = np.argsort(keys)
    rows, values = _measured(result, keys[order], order, voxel_m)
    sums = np.stack([np.bincount(rows, column, len(keys)) for column in values.T], axis=1)
    count = np.bincount(rows, minlength=len(keys))
    kept = np.flatnonzero(count)
    mean = sums[kept] / count[kept, None]
    return Known(
        names, tile[kept], voxel[kept], normal[kept], count[kept], mean[:, :3], mean[:, 3:6], mean[:, 6], mean[:, 7],
        mean[:, 8],
    )  # fmt: skip


def _points(result: Result) -> tuple[tuple[str, ...], I8, I8, F8, F8, float]:
    pieces = result.parts(Piece).by("tile")
    names, found = tuple(pieces), []
    for number, (name, parts) in enumerate(pieces.items()):
        of_tile = list(parts)
        size = of_tile[0].tile_size_m
        x, y = (float(word) * size for word in name.split("_"))
        ground = ground_of(of_tile, np.array([x, y, 0.0]), size)
        found.append((np.full(len(ground.voxel), number), ground.voxel, ground.points, ground.normal))
    tile, voxel, xyz, normal = (np.concatenate(column) for column in zip(*found))
    return names, tile, voxel, xyz, normal.astype(float), of_tile[0].voxel_size_m


def _keys(xyz: F8, voxel_m: float) -> I8:
    """One number for each voxel."""
    x, y, z = (np.floor(xyz / voxel_m).astype(np.int64) + _HALF).T
    return np.asarray((x << 2 * _SHIFT) | (y << _SHIFT) | z)


def _measured(result: Result, keys: I8, order: I8, voxel_m: float) -> tuple[I8, F8]:
    """Point of the map that each LiDAR point is in, and of it: true place, albedo, lit, static, ground (m, 9)."""
    truth, poses = result.parts(Truth)[0], result.parts(Poses)[0]
    pose_of = dict(zip(poses.scan_index.tolist(), poses.T_world_lidar))
    rows, values = [], []
    for scan, kept, label, paint in _scans(result):
        if scan.scan_index not in pose_of:
            continue
        local = np.column_stack((scan.x_m, scan.y_m, scan.z_m)).astype(float)[kept]
        at = _keys(transform(pose_of[scan.scan_index], local), voxel_m)
        place = np.minimum(np.searchsorted(keys, at), len(keys) - 1)
        hit = keys[place] == at
        T = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, np.array([scan.reference_ns]))[0]
        class_ = label.class_[kept]
        ground = class_ == PointClass.GROUND
        rows.append(order[place[hit]])
        values.append(
            np.column_stack(
                (
                    transform(T, local), LINEAR[paint.albedo[kept]], paint.lit[kept], ground | (class_ == PointClass.STATIC),
                    ground,
                )
            )[hit].astype(np.float32)
        )  # fmt: skip
    return np.concatenate(rows), np.concatenate(values)


def _scans(result: Result) -> Iterator[tuple[DeskewedScan, NDArray[np.bool_], TrueLabels, TruePaint]]:
    """Scan after scan: its points, which of them entered the map, and what they truly are."""
    folder = next(path for _, path in result.files(TruthLog))
    true = zip(
        TruePoints.open(Path(folder) / "points.parquet"), TrueColours.open(Path(folder) / "colours.parquet")
    )
    of_map = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)
    for deskewed, labels in zip(result.parts(Deskewed), result.parts(FinalLabels), strict=True):
        for scan, label in zip(deskewed, labels, strict=True):
            known_label, paint = next(true)
            if not scan.scan_index == known_label.scan_index == paint.scan_index or len(scan) != len(paint):
                raise SystemExit(f"truth of scan {paint.scan_index} is not that of scan {scan.scan_index}")
            yield scan, np.isin(label.class_, of_map) & np.isfinite(scan.x_m), known_label, paint
