"""Pieces: what one chunk of a session adds to each tile of the map."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Part, columns_of
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, ScanLabels
from scanloom.schemas.tiles import LEFT_OUT, RANK_SHIFT, Piece
from scanloom.schemas.trajectory import Poses
from scanloom.stages.tiling.grid import check_grid, tile_name
from scanloom.stages.tiling.voxel_sums import TileSums, VoxelSums

VERSION = 2


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


def tiling(
    settings: Settings, deskewed: Deskewed, labels: FinalLabels, poses: Poses
) -> Iterator[Part[Piece]]:
    """Sum the points of a chunk per voxel and yield one piece per tile, ordered by tile.

    Points that are left out of the map have rows of their own, one for each voxel and class. Memory is bounded by the voxels that the chunk fills, not by its points.

    Raises
    ------
    StageError : labels do not belong to the scans, or no scan of the chunk has a pose.
    """
    sums = _Sums(settings)
    pose_of = {int(index): T for index, T in zip(poses.scan_index, poses.T_world_lidar)}
    seen = placed = 0
    for scan, label in zip(deskewed, labels, strict=True):
        _check_pair(scan, label)
        seen += 1
        T = pose_of.get(scan.scan_index)
        if T is None or not np.isfinite(T).all():
            continue
        placed += 1
        sums.add(scan, label.class_, np.ascontiguousarray(T))
    if seen and not placed:
        raise StageError(
            "no scan of this chunk has a pose",
            next_step="look at the odometry of this session: it ended early",
        )
    for tile, parts in sums.tiles():
        yield Part(_piece(settings, parts, poses), tile_name(*tile))


class _Sums:
    """Sums per voxel: of what enters the map, and of each class that is left out."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._out = tuple(c for c in LEFT_OUT if c not in settings.classes)
        self._sums: dict[int, tuple[NDArray[np.bool_], VoxelSums]] = {}

    def add(self, scan: DeskewedScan, classes: NDArray[np.uint8], T_world_lidar: NDArray[np.float64]) -> None:
        self._add(0, scan, classes, T_world_lidar)
        met = np.bincount(classes, minlength=256)
        for class_ in self._out:
            if met[class_]:
                self._add(1 + LEFT_OUT.index(class_), scan, classes, T_world_lidar)

    def _add(self, rank: int, scan: DeskewedScan, classes: NDArray[np.uint8], T: NDArray[np.float64]) -> None:
        keep, sums = self._of(rank)
        xyz = (scan.x_m, scan.y_m, scan.z_m)
        sums.add(xyz, scan.intensity, classes, keep, int(PointClass.GROUND), T, scan.reference_ns)

    def _of(self, rank: int) -> tuple[NDArray[np.bool_], VoxelSums]:
        if rank not in self._sums:
            classes = self._settings.classes if rank == 0 else (LEFT_OUT[rank - 1],)
            sums = VoxelSums(self._settings.voxel_size_m, self._settings.tile_size_m)
            self._sums[rank] = (_kept(classes), sums)
        return self._sums[rank]

    def tiles(self) -> Iterator[tuple[tuple[int, int], list[tuple[int, TileSums]]]]:
        """Position of each tile, with its sums by rank, ordered."""
        found: dict[tuple[int, int], list[tuple[int, TileSums]]] = {}
        for rank in sorted(self._sums):
            for tile in self._sums[rank][1].tiles():
                found.setdefault(tile.tile, []).append((rank, tile))
        yield from sorted(found.items())


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


def _piece(settings: Settings, parts: list[tuple[int, TileSums]], poses: Poses) -> Piece:
    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(tile, name) for _, tile in parts])

    sums = [name for name in columns_of(Piece) if name != "voxel"]
    return Piece(
        voxel=np.concatenate([tile.voxel + (np.int64(rank) << RANK_SHIFT) for rank, tile in parts]),
        **{name: joined(name) for name in sums},
        frame=poses.frame,
        georeference=poses.georeference,
        voxel_size_m=settings.voxel_size_m,
        tile_size_m=settings.tile_size_m,
    )
