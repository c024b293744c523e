"""Lines over the cloud: trajectories, loops, boxes of what moved."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.loops import Loops
from scanloom.schemas.objects import ObjectClass, ObjectTracks
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.source import MapSource

Json = dict[str, Any]
MOST_POSES = 20_000
"""Of one session; a longer track is drawn with every n-th pose."""
MOST_LOOPS = 5_000
BOXES_PER_TRACK = 4


class Layers:
    """Read once, when the page asks first."""

    def __init__(self, source: MapSource) -> None:
        self._source = source

    def everything(self) -> Json:
        """Trajectories, loops and moving objects, coordinates in the frame of the map, m."""
        poses = self._source.trajectories()
        return {
            "trajectories": [_track(name, table) for name, table in poses.items()],
            "loops": self._loops(poses),
            "objects": [entry for name, table in poses.items() for entry in self._objects(name, table)],
        }

    def _loops(self, poses: dict[str, Poses]) -> list[Json]:
        path = self._source.folder / "loops.parquet"
        if not path.exists():
            return []
        loops, found = Loops.open(path), []
        place = {name: _places(table) for name, table in poses.items()}
        for n in np.flatnonzero(loops.accepted)[:MOST_LOOPS]:
            i = place.get(str(loops.session_i[n]), {}).get(int(loops.scan_i[n]))
            j = place.get(str(loops.session_j[n]), {}).get(int(loops.scan_j[n]))
            if i is not None and j is not None:
                found.append({"from": i, "to": j, "rmse_m": round(float(loops.rmse_m[n]), 4)})
        return found

    def _objects(self, session: str, poses: Poses) -> list[Json]:
        folder = self._source.folder
        path = folder / "objects.parquet"
        if not path.exists():
            path = folder / "objects" / f"{session}.parquet"
        if not path.exists():
            return []
        tracks = ObjectTracks.open(path)
        row = {int(scan): n for n, scan in enumerate(poses.scan_index)}
        known = np.array([int(scan) in row for scan in tracks.scan_index], bool)
        tracks = tracks.take(known & tracks.dynamic)
        at = [row[int(scan)] for scan in tracks.scan_index]
        T = poses.T_world_lidar[at] @ tracks.T_lidar_object
        return [
            _object(tracks, T, np.flatnonzero(tracks.track == number)) for number in np.unique(tracks.track)
        ]


def _track(name: str, poses: Poses) -> Json:
    step = max(1, -(-len(poses) // MOST_POSES))
    return {"session": name, "points": _rounded(poses.T_world_lidar[::step, :3, 3])}


def _object(tracks: ObjectTracks, T: NDArray[np.float64], rows: NDArray[np.int64]) -> Json:
    """One thing that moved: its way, and its box at a few places of it."""
    shown = rows[np.unique(np.linspace(0, len(rows) - 1, BOXES_PER_TRACK).round().astype(int))]
    return {
        "class": ObjectClass(int(tracks.class_[rows[0]])).name.lower(),
        "path": _rounded(T[rows, :3, 3]),
        "boxes": [
            {
                "matrix": np.round(T[n].T.reshape(-1), 5).tolist(),
                "size_m": [float(tracks.length_m[n]), float(tracks.width_m[n]), float(tracks.height_m[n])],
                "speed_m_s": round(float(tracks.speed_m_s[n]), 2),
            }
            for n in shown
        ],
    }


def _places(poses: Poses) -> dict[int, list[float]]:
    points = _rounded(poses.T_world_lidar[:, :3, 3])
    return {int(scan): point for scan, point in zip(poses.scan_index, points)}


def _rounded(points: NDArray[np.float64]) -> list[Any]:
    """Millimetres are enough for a line."""
    out: list[Any] = np.round(points, 3).tolist()
    return out
