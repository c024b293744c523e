"""The formats a map can be exported to.

A format is a pure function of a delivered map: `write(source, folder, options)` fills `folder`, which exists and is empty, tile by tile, and
returns the paths of its files, all inside. The verb `export` does the rest: it makes the folder beside its final place and renames it, so
that nothing is ever half written, and records files, checksums, bounds and versions in `exports.json`. A module of a format imports what is not part of every
installation inside its functions; `needs` names these modules and `extra` what installs them. To add a format: write the module, add one row.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from scanloom.schemas.errors import UsageError
from scanloom.stages.exports.autoware import write_autoware
from scanloom.stages.exports.copc import write_copc
from scanloom.stages.exports.dem import write_dem
from scanloom.stages.exports.geojson import write_geojson
from scanloom.stages.exports.geoparquet import write_geoparquet
from scanloom.stages.exports.gpx import write_gpx
from scanloom.stages.exports.las import write_laz
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.orthophoto import write_orthophoto
from scanloom.stages.exports.pcd import write_pcd
from scanloom.stages.exports.ply import write_ply
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.stac import write_stac
from scanloom.stages.exports.tiles3d import write_3d_tiles
from scanloom.stages.exports.trajectory import write_kitti, write_tum

Write = Callable[[MapSource, Path, Options], list[Path]]


@dataclass(frozen=True)
class Format:
    """One format: what `--format` calls it, one sentence for the help, what must be installed, how it is written."""

    name: str
    doc: str
    write: Write
    extra: str | None = None
    """Extra of this package that brings `needs`; None where everything is always there."""
    needs: tuple[str, ...] = ()
    """Modules that are not part of every installation."""
    cloud: bool = False
    """Whether it holds every point of the map, and with `removed` those that are left out."""
    passes: int = 1
    """How often it reads the tiles of the map; 0 when it needs none."""
    lists_others: bool = False
    """Made from the other exports beside it, hence written after them."""
    version: int = 1
    """Raised when the same map would give other files: old exports are then made anew."""


_ROWS: tuple[Format, ...] = (
    Format("ply", "whole map with all columns, float32 from an offset", write_ply, cloud=True),
    Format("pcd", "whole map as x y z intensity class, float32 from an offset", write_pcd, cloud=True),
    Format(
        "laz",
        "whole map as LAZ 1.4 with its coordinate system",
        write_laz,
        "las",
        ("laspy", "lazrs"),
        cloud=True,
    ),
    Format(
        "copc",
        "the same as COPC 1.0, to stream by level of detail",
        write_copc,
        "las",
        ("laspy", "lazrs"),
        cloud=True,
    ),
    Format(
        "autoware",
        "map folder of Autoware: PCD on a grid of 20 m and its place on the Earth",
        write_autoware,
        cloud=True,
    ),
    Format("3dtiles", "whole map as 3D Tiles 1.1 with glTF contents, on the globe", write_3d_tiles),
    Format("tum", "trajectory as text of TUM, in the map's frame", write_tum, passes=0),
    Format(
        "kitti",
        "trajectory as text of KITTI: 3 x 4 matrices of the LiDAR, in the map's frame",
        write_kitti,
        passes=0,
    ),
    Format("gpx", "trajectory as GPX 1.1", write_gpx, passes=0),
    Format("geojson", "trajectory as GeoJSON", write_geojson, passes=0),
    Format(
        "geoparquet",
        "trajectory as GeoParquet 1.1, a row per scan with standard deviations",
        write_geoparquet,
        passes=0,
    ),
    Format("dem", "heights of the ground as GeoTIFF", write_dem, "raster", ("rasterio",)),
    Format(
        "orthophoto",
        "intensity and colour from above as GeoTIFF",
        write_orthophoto,
        "raster",
        ("rasterio",),
        passes=2,
        version=2,
    ),
    Format(
        "stac",
        "catalogue item of the map and all its exports",
        write_stac,
        "stac",
        ("pystac",),
        passes=0,
        lists_others=True,
    ),
)
"""In the order in which they are written when all are asked for; the catalogue last, since it lists the others."""

FORMATS: Mapping[str, Format] = {row.name: row for row in _ROWS}


def chosen(names: list[str]) -> list[Format]:
    """Formats by name, each once, in the order asked for.

    Raises
    ------
    UsageError : a name that no format has, or a format whose library is not installed.
    """
    if not names:
        raise UsageError("no format is named", next_step=f"give --format with some of: {', '.join(FORMATS)}")
    found = [_named(name) for name in dict.fromkeys(names)]
    for entry in found:
        missing = [module for module in entry.needs if find_spec(module) is None]
        if missing:
            raise UsageError(
                f"the format {entry.name} needs {', '.join(missing)}, which is not installed",
                next_step=f"pip install 'scanloom[{entry.extra}]', in a checkout .venv/bin/pip install -e '.[{entry.extra}]'",
            )
    return found


def _named(name: str) -> Format:
    if name in FORMATS:
        return FORMATS[name]
    near = difflib.get_close_matches(name, FORMATS, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}? " if near else ""
    raise UsageError(f"there is no format {name!r}", next_step=f"{hint}known: {', '.join(FORMATS)}")
