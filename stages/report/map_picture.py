"""Picture: the map from above, with the trajectory, loops and GNSS on it."""

from __future__ import annotations

import io
import json
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.evaluation import PictureFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import RemovedTile, Tile, TileIndex
from scanloom.schemas.trajectory import Poses
from scanloom.stages.report.left_out import left_out
from scanloom.stages.report.marks import map_marks
from scanloom.stages.report.overlay import Mark, paint, scale_bar, to_svg
from scanloom.stages.report.raster import View, draw_map, fit_view

VERSION = 1

PREVIEW, OVERLAY, LEFT_OUT, VIEW = "preview.png", "overlay.svg", "left_out.png", "view.json"
LAYERS = {
    "height": "height.webp",
    "intensity": "intensity.webp",
    "classes": "classes.webp",
    "colour": "colour.webp",
}
"""The map alone, coloured by what the key says; `colour` only where cameras saw it."""
_QUALITY = 72


class Settings(BaseModel):
    """What the picture shows."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    longest_px: int = Field(1600, ge=200, le=8000, description="longer side of the map's picture, pixels")
    margin_m: float = Field(
        40.0, ge=0.0, le=1000.0, description="what the picture shows around the trajectory, m"
    )


def picture(
    settings: Settings,
    poses: Parts[Poses],
    loops: Loops,
    graph: Graph,
    tile_index: TileIndex,
    tiles: Parts[Tile],
    removed: Parts[RemovedTile] | None = None,
) -> PictureFiles:
    """Draw the map, tile by tile, what lies on it, and on a sheet of its own what was left out of it."""
    paths = {c["session"]: p for c, p in poses.items()}
    view = _view(settings, paths, tile_index)
    drawn = draw_map(tiles, view)
    factor = max(settings.longest_px // max(view.width, view.height), 1)
    view = view.enlarged(factor)
    layers = {
        "height": _enlarge(drawn.height, view, Image.Resampling.BICUBIC),
        "intensity": _enlarge(drawn.intensity, view, Image.Resampling.BICUBIC),
        "classes": _enlarge(drawn.classes, view, Image.Resampling.NEAREST),
    }
    if drawn.colour is not None:
        layers["colour"] = _enlarge(drawn.colour, view, Image.Resampling.BICUBIC)
    marks: list[Mark] = map_marks(view, paths, loops, graph) + scale_bar(view)
    return PictureFiles(
        contents={
            PREVIEW: _encoded(paint(np.asarray(layers["height"]), marks), "PNG", compress_level=3),
            **{
                LAYERS[name]: _encoded(image, "WEBP", quality=_QUALITY, method=4)
                for name, image in layers.items()
            },
            OVERLAY: to_svg(marks, view).encode(),
            LEFT_OUT: _encoded(left_out(removed or (), view), "PNG", optimize=1, transparency=0),
            VIEW: json.dumps(asdict(view)).encode(),
        }
    )


def _enlarge(picture: NDArray[np.uint8], view: View, by: Image.Resampling) -> Image.Image:
    """A small map with larger pixels, so that lines and letters on it are sharp."""
    return Image.fromarray(picture).resize((view.width, view.height), by)


def _view(settings: Settings, paths: dict[str, Poses], index: TileIndex) -> View:
    """Around the trajectories; without any, around the tiles."""
    driven = [p.T_world_lidar[:, :2, 3] for p in paths.values() if len(p)]
    corners = np.concatenate(driven) if driven else np.concatenate((index.min_m, index.max_m))[:, :2]
    if len(corners) == 0:
        corners = np.zeros((1, 2))
    finest_m = 1.25 * index.voxel_size_m
    return fit_view(
        corners.min(axis=0), corners.max(axis=0), settings.margin_m, settings.longest_px, finest_m
    )


def _encoded(image: Image.Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()
