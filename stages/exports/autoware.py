"""A map for Autoware: PCD files on a grid of 20 m, their list, and how the map stands on the Earth.

Autoware keeps a map in metres of a local frame. Of the frames it can compute with in every node, `LocalCartesianUTM` is the
one that fits: x and y are UTM coordinates less those of the origin, z is the height itself, since Autoware sets the height
of the origin to zero whatever the file says (its map_projection_loader). The local east-north-up frame of our maps would be
its `LocalCartesian`, which its GNSS and localisation nodes do not know. A map without georeference is `Local`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import UsageError
from scanloom.stages.exports.blocks import Grid, Pool, Rows, plan
from scanloom.stages.exports.clouds import cloud_of, points_of
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.pcd import header, rows
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import utm_epsg

CELL_M = 20
"""What Autoware's documentation recommends; a whole number, since it reads corners as integers."""
EGM2008 = 3855
FOLDER, LIST, PLACE = "pointcloud_map.pcd", "pointcloud_map_metadata.yaml", "map_projector_info.yaml"


def write_autoware(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`pointcloud_map.pcd/` with a file per cell, `pointcloud_map_metadata.yaml`, `map_projector_info.yaml`.

    Raises
    ------
    UsageError : coordinates or heights are asked for that Autoware has no name for.
    """
    projector = _projector(source, options)
    offset_m = _origin(projector)
    grid = Grid(offset_m[:2], float(CELL_M))
    pool = _pool(source, projector, options, grid, offset_m)
    (folder / FOLDER).mkdir()
    corners: dict[str, tuple[int, int]] = {}
    for block in pool.parts:
        points = pool.take(block)
        if points:
            x, y = block[0] * CELL_M, block[1] * CELL_M
            corners[f"pointcloud_map_{x}_{y}.pcd"] = (x, y)
            _write_cell(folder / FOLDER / f"pointcloud_map_{x}_{y}.pcd", points)
    pool.check_all_taken(points_of(source, options))
    (folder / LIST).write_text(_list(corners))
    (folder / PLACE).write_text(_place(projector))
    return [folder / LIST, folder / PLACE, *(folder / FOLDER / name for name in corners)]


def _projector(source: MapSource, options: Options) -> Projector:
    projector = Projector.of(source, options)
    if (origin := projector.georeference) is None:
        return projector
    zone = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    if options.epsg not in (None, zone):
        raise UsageError(
            f"Autoware computes in the UTM zone of the map's origin, EPSG:{zone}, not in EPSG:{options.epsg}",
            next_step="leave --epsg out for this format",
        )
    if projector.vertical_epsg not in (None, EGM2008):
        raise UsageError(
            f"Autoware knows heights above the ellipsoid and above EGM2008, not those of EPSG:{projector.vertical_epsg}",
            next_step=f"take --heights ellipsoidal, or --vertical-epsg {EGM2008}",
        )
    return Projector(origin, zone, projector.vertical_epsg)


def _origin(projector: Projector) -> NDArray[np.float64]:
    """What Autoware subtracts: the origin's easting and northing, and nothing from the height."""
    if projector.epsg is None:
        return np.zeros(3)
    return np.asarray(projector.project(np.zeros((1, 3)))[0] * [1.0, 1.0, 0.0])


def _pool(
    source: MapSource, projector: Projector, options: Options, grid: Grid, offset_m: NDArray[np.float64]
) -> Pool:
    def load(name: str) -> tuple[Rows, NDArray[np.int64]]:
        points = rows(cloud_of(source, projector, name), offset_m)
        # By the rounded coordinates: what the file says lies where the list says.
        at = np.column_stack((points["x"], points["y"])).astype(np.float64)
        return points, np.floor(at / CELL_M).astype(np.int64)

    return Pool(plan(source, projector, options, grid, slack=0.1), load)


def _write_cell(path: Path, parts: list[Rows]) -> None:
    with path.open("wb") as stream:
        stream.write(header(sum(map(len, parts)), ["scanloom: one cell of a map for Autoware"]))
        stream.writelines(part.data for part in parts)


def _list(corners: dict[str, tuple[int, int]]) -> str:
    lines = [f"x_resolution: {CELL_M}.0", f"y_resolution: {CELL_M}.0"]
    return "\n".join([*lines, *(f"{name}: [{x}, {y}]" for name, (x, y) in corners.items())]) + "\n"


def _place(projector: Projector) -> str:
    origin = projector.georeference
    if origin is None:
        return "projector_type: Local\n"
    datum = "WGS84" if projector.vertical_epsg is None else "EGM2008"
    return (
        "projector_type: LocalCartesianUTM\n"
        f"vertical_datum: {datum}\n"
        "map_origin:\n"
        f"  latitude: {origin.latitude_deg!r}\n"
        f"  longitude: {origin.longitude_deg!r}\n"
        "  altitude: 0.0\n"
    )
