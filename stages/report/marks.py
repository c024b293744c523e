"""Trajectories, loops and GNSS fixes as marks on the map's picture."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry.factor_rows import USED, fix_rows, loop_verdicts
from scanloom.stages.report.loop_graph import loop_ends
from scanloom.stages.report.overlay import (
    GNSS_COLOUR,
    INK,
    LOOP_COLOUR,
    SESSION_COLOURS,
    Dot,
    Line,
    Mark,
    view_unit,
)
from scanloom.stages.report.raster import View

_MAX_PATH_POINTS = 4000
_MAX_FIXES = 1500


def map_marks(view: View, paths: Mapping[str, Poses], loops: Loops, graph: Graph) -> list[Mark]:
    """GNSS below, then the trajectories from session to session, then the loops in use."""
    marks: list[Mark] = []
    for points in fix_positions(paths, graph).values():
        marks += _fixes(view, points)
    for number, poses in enumerate(paths.values()):
        marks += _path(view, poses, SESSION_COLOURS[number % len(SESSION_COLOURS)])
    used = np.flatnonzero(loop_verdicts(loops, graph) == USED)
    return marks + _loops(view, paths, loops, used)


def fix_positions(paths: Mapping[str, Poses], graph: Graph) -> dict[str, NDArray[np.float64]]:
    """Positions (n, 3) of the fixes of every session whose map has a georeference, used or not, m."""
    found = {}
    for name, fixes in fix_rows(graph).items():
        if name in paths and paths[name].georeference is not None:
            found[name] = fixes.position_m[np.isfinite(fixes.position_m[:, :2]).all(axis=1)]
    return found


def _path(view: View, poses: Poses, colour: str) -> list[Mark]:
    if len(poses) == 0:
        return []
    unit = view_unit(view)
    rows = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MAX_PATH_POINTS)).round().astype(int))
    xy = view.pixels(poses.T_world_lidar[rows, :2, 3])
    start, end = xy[0], xy[-1]
    line: list[Mark] = (
        [Line(xy, "#0d1117", 0.55 * unit, 0.6), Line(xy, colour, 0.3 * unit)] if len(xy) > 1 else []
    )
    return [
        *line,
        Dot(start[0], start[1], 0.7 * unit, INK),
        Dot(start[0], start[1], 0.45 * unit, "#2ea043", tip="start"),
        Dot(end[0], end[1], 0.7 * unit, INK),
        Dot(end[0], end[1], 0.45 * unit, "#da3633", tip="end"),
    ]


def _fixes(view: View, points: NDArray[np.float64]) -> list[Mark]:
    unit = view_unit(view)
    xy = view.pixels(points[:: max(len(points) // _MAX_FIXES, 1), :2])
    seen = ((xy >= 0) & (xy <= (view.width, view.height))).all(axis=1)
    return [Dot(x, y, 0.22 * unit, GNSS_COLOUR, 0.8) for x, y in xy[seen]]


def _loops(view: View, paths: Mapping[str, Poses], loops: Loops, rows: NDArray[np.int64]) -> list[Mark]:
    unit = view_unit(view)
    marks: list[Mark] = []
    for k, ends_m in zip(rows, loop_ends(paths, loops)[rows]):
        if not np.isfinite(ends_m).all():
            continue
        ends = view.pixels(ends_m)
        marks.append(Line(ends, LOOP_COLOUR, 0.25 * unit, 0.9))
        tip = f"loop: scan {loops.scan_i[k]} and {loops.scan_j[k]}, rmse {loops.rmse_m[k]:.2f} m"
        marks += [Dot(x, y, 0.32 * unit, LOOP_COLOUR, 0.9, tip) for x, y in ends]
    return marks
