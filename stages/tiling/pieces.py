"""Pieces: what one chunk of a session adds to each tile of the map."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Part
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.tiling.grid import check_grid, tile_name
from scanloom.stages.tiling.voxel_sums import TileSums, VoxelSums

VERSION = 1


class Settings(BaseModel):
    """How the map is cut and thinned, and which points enter it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_size_m: float = Field(
        0.1, ge=0.01, le=5.0, description="edge of a voxel; the map keeps one point in each, m"
    )
    tile_size_m: float = Field(
        50.0, ge=1.0, le=1000.0, description="edge of a tile, a multiple of the voxel, m"
    )
    classes: tuple[PointClass, ...] = Field(
        (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC),
        min_length=1,
        description="classes of points that enter the map",
    )

    @model_validator(mode="after")
    def _grid_fits(self) -> Self:
        check_grid(self.tile_size_m, self.voxel_size_m)
        return self


def tiling(settings: Settings, deskewed: Deskewed, labels: Labels, poses: Poses) -> Iterator[Part[Piece]]:
    """Sum the kept points of a chunk per voxel and yield one piece per tile, ordered by tile.

    Memory is bounded by the voxels that the chunk fills, not by its points.

    Raises
    ------
    StageError : labels do not belong to the scans, or no scan of the chunk has a pose.
    """
    sums = VoxelSums(settings.voxel_size_m, settings.tile_size_m)
    pose_of = {int(index): T for index, T in zip(poses.scan_index, poses.T_world_lidar)}
    keep = _kept(settings.classes)
    seen = placed = 0
    for scan, label in zip(deskewed, labels, strict=True):
        _check_pair(scan, label)
        seen += 1
        T = pose_of.get(scan.scan_index)
        if T is None or not np.isfinite(T).all():
            continue
        placed += 1
        xyz = (scan.x_m, scan.y_m, scan.z_m)
        sums.add(xyz, scan.intensity, label.class_, keep, int(PointClass.GROUND), np.ascontiguousarray(T))
    if seen and not placed:
        raise StageError(
            "no scan of this chunk has a pose",
            next_step="look at the odometry of this session: it ended early",
        )
    for tile in sums.tiles():
        yield Part(_piece(settings, tile, poses), tile_name(*tile.tile))


def _kept(classes: tuple[PointClass, ...]) -> NDArray[np.bool_]:
    keep = np.zeros(256, np.bool_)
    keep[[int(c) for c in classes]] = True
    return keep


def _check_pair(scan: DeskewedScan, label: ScanLabels) -> None:
    if scan.scan_index != label.scan_index or len(scan) != len(label):
        raise StageError(
            f"labels of scan {label.scan_index} ({len(label)} points) do not belong to "
            f"scan {scan.scan_index} ({len(scan)} points)",
            next_step="run denoise again",
        )


def _piece(settings: Settings, tile: TileSums, poses: Poses) -> Piece:
    return Piece(
        voxel=tile.voxel,
        count=tile.count,
        sum_x_m=tile.sum_x_m,
        sum_y_m=tile.sum_y_m,
        sum_z_m=tile.sum_z_m,
        sum_intensity=tile.sum_intensity,
        ground_count=tile.ground_count,
        scan_count=tile.scan_count,
        frame=poses.frame,
        georeference=poses.georeference,
        voxel_size_m=settings.voxel_size_m,
        tile_size_m=settings.tile_size_m,
    )
