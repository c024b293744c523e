"""What of an extended map is no longer there: where, how large, and how often it was seen through."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.changes import Changes
from scanloom.stages.report.plan import marks_plan
from scanloom.stages.report.plots import NOTHING, Plot, Trace
from scanloom.stages.report.ways import Way

_MOST_LISTED = 12


@dataclass(frozen=True)
class Gone:
    """One object: middle of its points and their extent (3,), m."""

    middle_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    points: int
    through: float
    """Scans that looked through it, in the middle of its points."""


@dataclass(frozen=True)
class Changed:
    """All objects that are gone, the largest listed; `sessions` are those that looked."""

    sessions: tuple[str, ...]
    plot: Plot
    objects: int
    points: int
    remnants: int
    """Points besides that only moving things had left in the map."""
    listed: list[Gone]


def changed(ways: Mapping[str, Way], changes: Changes | None) -> Changed | None:
    """What the new sessions saw through; None for a map that extends none."""
    if changes is None or not changes.sessions:
        return None
    numbers, counts = np.unique(changes.object_, return_counts=True)
    rows = np.split(np.argsort(changes.object_, kind="stable"), np.cumsum(counts)[:-1])
    objects = [_gone(changes, part) for part in rows if len(part)]
    objects.sort(key=lambda gone: -gone.points)
    return Changed(
        changes.sessions,
        _drawn(ways, objects),
        len(numbers),
        len(changes),
        changes.remnants,
        objects[:_MOST_LISTED],
    )


def _gone(changes: Changes, rows: NDArray[np.int64]) -> Gone:
    xyz = np.column_stack((changes.x_m[rows], changes.y_m[rows], changes.z_m[rows]))
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    x, y, z = (0.5 * (low + high)).tolist()
    length, width, height = (high - low).tolist()
    return Gone((x, y, z), (length, width, height), len(rows), float(np.median(changes.through[rows])))


def _drawn(ways: Mapping[str, Way], objects: list[Gone]) -> Plot:
    """The objects as dots on the tracks."""
    if not objects:
        return NOTHING
    size = [" × ".join(f"{side:.1f}" for side in gone.size_m) for gone in objects]
    dots: Trace = {
        "type": "scatter", "mode": "markers", "name": "no longer there",
        "x": [round(gone.middle_m[0], 1) for gone in objects], "y": [round(gone.middle_m[1], 1) for gone in objects],
        "text": [f"{gone.points} points, {sides} m" for gone, sides in zip(objects, size)],
        "hovertemplate": "%{text}<extra></extra>", "marker": {"color": "--bad", "size": 8}, "showlegend": True,
    }  # fmt: skip
    return marks_plan("What has changed, from above", ways, [dots])
