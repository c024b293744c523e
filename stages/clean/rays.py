"""Rays: what the scans of one chunk say of the free space around them, voxel by voxel and tile by tile.

Scans are taken together in bins of a fraction of a second. Each return marks its voxel and blocks those around it for its
bin; then the rays of a scan in its middle are walked from the sensor, where they lie closer together than voxels only one of
them, to well before their returns, and what they pass unblocked was free in this bin.
Poses are those of the finished map. Source: methods 1.5.1 and 1.5.2 (occupancy by rays), with two differences: bins instead
of log-odds, so that what stood for long and then left is told from what is half transparent; and the blocked neighbourhood,
which takes up errors of poses and ranges.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.clean import BRICK_SIDE, Rays
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Part
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Poses
from scanloom.stages.clean import incidence
from scanloom.stages.clean.field import AFTER, BEFORE, BETWEEN, HITS, TRACKED
from scanloom.stages.clean.field import Field as VoxelField
from scanloom.stages.clean.leading import followed_since
from scanloom.stages.clean.moving import MovingBoxes, boxed
from scanloom.stages.clean.tiles import bricks_by_tile
from scanloom.stages.clean.walking import counted, mark_hits, walk

VERSION = 1

SEEN = np.isin(
    list(PointClass), (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC, PointClass.DYNAMIC)
)
"""Classes whose returns end a ray; those of dust, strays and the own vehicle say nothing."""


class Settings(BaseModel):
    """How finely free space is resolved, and how close to a return a ray counts."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_size_m: float = Field(0.2, ge=0.05, le=1.0, description="edge of a voxel, m")
    tile_size_m: float = Field(
        50.0, ge=8.0, le=1000.0, description="edge of a tile that is decided as one, m"
    )
    bin_s: float = Field(0.3, ge=0.0, le=10.0, description="scans within this time speak as one, s")
    walked_scans: int = Field(
        1,
        ge=1,
        le=100,
        description="scans of a bin whose rays are followed, number; neighbouring scans see nearly the same",
    )
    reach_m: float = Field(60.0, ge=5.0, le=300.0, description="rays say nothing beyond this range, m")
    clearance_m: float = Field(
        0.3, ge=0.0, le=5.0, description="a ray counts until it comes this close to the surface it meets, m"
    )
    tracked_margin_m: float = Field(
        0.1, ge=0.0, le=2.0, description="returns this close to the box of a moving object are its own, m"
    )


Pair = tuple[DeskewedScan, ScanLabels]


def rays(
    settings: Settings, deskewed: Deskewed, labels: Labels, tracks: ObjectTracks, poses: Poses
) -> Iterator[Part[Rays]]:
    """Bins that hit and that saw through each voxel, for every tile that the chunk's rays cross.

    Memory is bounded by the space that the chunk sees.
    """
    T_of = {int(i): T for i, T in zip(poses.scan_index, poses.T_world_lidar) if np.isfinite(T).all()}
    field, image, first_ns, moving = VoxelField(), incidence.new_image(), 0, MovingBoxes(tracks)
    for pairs in _bins(deskewed, labels, settings.bin_s):
        first_ns = first_ns or pairs[0][0].reference_ns
        placed = [
            (
                *_seen(scan, label, boxed(scan, moving.of(scan), settings.tracked_margin_m)),
                T_of[scan.scan_index],
            )
            for scan, label in pairs
            if scan.scan_index in T_of
        ]
        _mark(settings, field, image, placed)
        field.settle()
    yield from _parts(settings, field, first_ns, poses.frame)


def _bins(deskewed: Deskewed, labels: Labels, bin_s: float) -> Iterator[list[Pair]]:
    """Scans with their labels, those of a bin together."""
    waiting: list[Pair] = []
    for pair in zip(deskewed, labels, strict=True):
        if waiting and pair[0].reference_ns - waiting[0][0].reference_ns > 1e9 * bin_s:
            yield waiting
            waiting = []
        waiting.append(pair)
    if waiting:
        yield waiting


def _seen(scan: DeskewedScan, label: ScanLabels, tracked: np.ndarray) -> tuple[np.ndarray, ...]:
    """x, y, z, class and whether it moved (n,) of the returns that count."""
    found: tuple[np.ndarray, ...] = counted(scan.x_m, scan.y_m, scan.z_m, label.class_, tracked, SEEN)
    return found


def _mark(settings: Settings, field: VoxelField, image: np.ndarray, placed: list[tuple]) -> None:
    """All returns of a bin before the rays of its middle: a return of one scan blocks the rays of the others."""
    for x, y, z, classes, moved, T in placed:
        _until_done(
            field, mark_hits, (x, y, z, classes, moved, T, settings.reach_m, settings.voxel_size_m), len(x)
        )
    spare = max(len(placed) - settings.walked_scans, 0)
    for x, y, z, _, _, T in placed[spare // 2 : len(placed) - (spare - spare // 2)]:
        cell, _ = incidence.fill(x, y, z, image)
        clear = incidence.clear_ranges(x, y, z, cell, image, settings.clearance_m)
        since = followed_since(cell, clear, settings.voxel_size_m)
        _until_done(field, walk, (x, y, z, since, clear, T, settings.reach_m, settings.voxel_size_m), len(x))


def _until_done(field: VoxelField, kernel: object, arguments: tuple, count: int) -> None:
    """Go on where the field was full, with more room."""
    done = 0
    while True:
        done = kernel(*arguments, done, field.keys, field.rows, field.order, field.count, field.now)  # type: ignore[operator]
        if done == count:
            return
        field.grow()


def _parts(settings: Settings, field: VoxelField, first_ns: int, frame: str) -> Iterator[Part[Rays]]:
    brick_m = BRICK_SIDE * settings.voxel_size_m
    for name, rows in bricks_by_tile(field.bricks, brick_m, settings.tile_size_m, settings.voxel_size_m):
        layers = field.counts[rows]
        yield Part(
            Rays(
                brick=field.bricks[rows],
                hits=np.ascontiguousarray(layers[:, HITS]),
                tracked=np.ascontiguousarray(layers[:, TRACKED]),
                before=np.ascontiguousarray(layers[:, BEFORE]),
                between=np.ascontiguousarray(layers[:, BETWEEN]),
                after=np.ascontiguousarray(layers[:, AFTER]),
                first_ns=first_ns,
                voxel_size_m=settings.voxel_size_m,
                tile_size_m=settings.tile_size_m,
                frame=frame,
            ),
            name,
        )
