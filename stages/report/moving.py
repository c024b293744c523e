"""What moved and what was in the air: objects by class and where they went, and the share of each scan left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.objects import ObjectClass, ObjectTracks
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import LEFT_OUT
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.along import along
from scanloom.stages.report.known import share_percent
from scanloom.stages.report.left_out import WORDS
from scanloom.stages.report.plan import marks_plan
from scanloom.stages.report.plots import I8, NOTHING, Plot, Trace, fixed, upwards
from scanloom.stages.report.ways import Way, curve

CLASSES = {
    ObjectClass.VEHICLE: ("cars", "--curve-1"),
    ObjectClass.TRUCK: ("trucks and buses", "--curve-3"),
    ObjectClass.CYCLIST: ("cyclists", "--good"),
    ObjectClass.PERSON: ("people", "--bad"),
    ObjectClass.UNKNOWN: ("other things", "--soft"),
}
SHARES = {
    PointClass.DYNAMIC: "--bad",
    PointClass.AIRBORNE: "--curve-1",
    PointClass.OUTLIER: "--quiet",
    PointClass.CHANGED: "--curve-2",
}
_MOST_VERTICES = 6000
"""Of all tracks drawn."""


@dataclass(frozen=True)
class ObjectRow:
    """Objects of one class: how many tracks, their speed and how long they were followed, in words."""

    words: str
    tracks: int
    median_m_s: float
    fastest_m_s: float
    followed_s: float


@dataclass(frozen=True)
class Moving:
    """The tracks from above and their table; nothing without tracks."""

    plot: Plot
    rows: list[ObjectRow]

    @property
    def tracks(self) -> int:
        return sum(row.tracks for row in self.rows)


def moving(
    objects: Mapping[str, ObjectTracks], paths: Mapping[str, Poses], ways: Mapping[str, Way]
) -> Moving:
    """All sessions together; a track is counted once."""
    rows = [_row(class_, words, list(objects.values())) for class_, (words, _) in CLASSES.items()]
    marks = [mark for class_ in CLASSES for mark in _lines(class_, objects, paths)]
    return Moving(marks_plan("What moved, from above", ways, marks), [row for row in rows if row.tracks])


def _row(class_: ObjectClass, words: str, sessions: list[ObjectTracks]) -> ObjectRow:
    middles, fastest, lengths = [], 0.0, []
    for tracks in sessions:
        own = np.flatnonzero((tracks.class_ == class_) & tracks.dynamic)
        for rows in _by_track(tracks.track[own]):
            speed = tracks.speed_m_s[own[rows]]
            middles.append(float(np.median(speed)))
            fastest = max(fastest, float(np.quantile(speed, 0.95)))
            lengths.append(float(np.ptp(tracks.stamp_ns[own[rows]])) * 1e-9)
    if not middles:
        return ObjectRow(words, 0, 0.0, 0.0, 0.0)
    return ObjectRow(words, len(middles), float(np.median(middles)), fastest, float(np.median(lengths)))


def _by_track(track: NDArray[np.int32]) -> list[I8]:
    """Rows of each track, in order."""
    order = np.argsort(track, kind="stable")
    starts = np.flatnonzero(np.diff(track[order])) + 1
    return [rows for rows in np.split(order, starts) if len(rows)]


def _lines(
    class_: ObjectClass, objects: Mapping[str, ObjectTracks], paths: Mapping[str, Poses]
) -> list[Trace]:
    """One trace with every track of a class, gaps between them."""
    pieces = []
    for name, tracks in objects.items():
        own = np.flatnonzero((tracks.class_ == class_) & tracks.dynamic)
        if name in paths and len(paths[name]) and len(own):
            xy = _places(tracks, own, paths[name])
            pieces += [xy[rows] for rows in _by_track(tracks.track[own])]
    if not pieces:
        return []
    step = max(-(-sum(map(len, pieces)) // _MOST_VERTICES), 1)
    gap = np.full((1, 2), np.nan)
    xy = np.concatenate([part for piece in pieces for part in (piece[::step], gap)])
    words, colour = CLASSES[class_]
    return [
        {
            "type": "scatter", "mode": "lines+markers", "name": words, "x": fixed(xy[:, 0], 1), "y": fixed(xy[:, 1], 1),
            "line": {"color": colour, "width": 1.2}, "marker": {"size": 3, "color": colour}, "hoverinfo": "name",
            "showlegend": True,
        }
    ]  # fmt: skip


def _places(tracks: ObjectTracks, own: I8, poses: Poses) -> F8:
    """Places (n, 2) in the map of boxes, by the pose of the scan each was seen in; NaN where there is none."""
    row = np.clip(np.searchsorted(poses.scan_index, tracks.scan_index[own]), 0, len(poses) - 1)
    T = poses.T_world_lidar[row] @ tracks.T_lidar_object[own]
    known = poses.scan_index[row] == tracks.scan_index[own]
    return np.asarray(np.where(known[:, None], T[:, :2, 3], np.nan))


def share_chart(session: str, counts: ClassCounts, way: Way) -> Plot:
    """Share of each scan that was left out of the map, class by class, over the distance driven."""
    if not len(counts) or not len(way):
        return NOTHING
    rows = way.at_scans(counts.scan_index)
    data, most = [], [np.zeros(1)]
    for class_ in LEFT_OUT:
        share = share_percent(counts.points, class_)
        if share.any():
            data.append(curve(WORDS[class_], way, rows, share, SHARES[class_], "%"))
            most.append(share)
    y_axis = upwards("share of the scan, %", np.concatenate(most))
    return along(session, "Share of each scan left out of the map", way, data, y_axis) if data else NOTHING
