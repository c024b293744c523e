"""Names and settings of the tile grid."""

from __future__ import annotations

from scanloom.stages.tiling.voxel_sums import MAX_VOXELS_PER_SIDE


def tile_name(x: int, y: int) -> str:
    """Name of the tile whose lower corner is (x, y) times the tile size, for instance `3_-1`."""
    return f"{x}_{y}"


def tile_position(name: str) -> tuple[int, int]:
    """Inverse of `tile_name`."""
    x, y = name.split("_")
    return int(x), int(y)


def check_grid(tile_size_m: float, voxel_size_m: float) -> None:
    """A tile must hold a whole number of voxels per side.

    Raises
    ------
    ValueError : it does not, or it holds too many.
    """
    side = tile_size_m / voxel_size_m
    if abs(side - round(side)) > 1e-6 * side:
        raise ValueError(f"tile_size_m {tile_size_m} is no multiple of voxel_size_m {voxel_size_m}")
    if not 1 <= round(side) <= MAX_VOXELS_PER_SIDE:
        raise ValueError(f"a tile may have 1 to {MAX_VOXELS_PER_SIDE} voxels per side, not {round(side)}")
