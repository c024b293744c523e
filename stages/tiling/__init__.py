"""Tiling: from labelled scans and optimised poses to a voxel-filtered, tiled map."""

from scanloom.stages.tiling.overview import overview
from scanloom.stages.tiling.pieces import tiling
from scanloom.stages.tiling.tiles import tiles

__all__ = ["overview", "tiles", "tiling"]
