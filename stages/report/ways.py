"""The way of each session: where each scan was, how far it had driven, and what was known of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.alignment import travelled
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.report.plots import I8, MOST_POINTS, Trace, fixed, short, thin

DRIVEN = "distance driven, m"
_MOST_OF_ALL, _LEAST_POINTS = 6000, 500
"""Points that a curve of all sessions together has, and of each at least: a page of many sessions stays small."""


@dataclass(frozen=True)
class Way:
    """Scans of a session in order: numbers (n,), stamps (n,), metres driven (n,), places (n, 3)."""

    scan_index: I8
    stamp_ns: I8
    driven_m: F8
    place_m: F8
    most: int = MOST_POINTS
    """Points of a curve along it."""

    def __len__(self) -> int:
        return len(self.scan_index)

    @property
    def length_m(self) -> float:
        return float(self.driven_m[-1]) if len(self) else 0.0

    @property
    def start_s(self) -> float:
        """Stamp of the first scan."""
        return round(int(self.stamp_ns[0]) * 1e-9, 2) if len(self) else 0.0

    def at_scans(self, scans: I8) -> I8:
        """Rows of scans (n,), by number; the next one where a scan has no pose."""
        return np.clip(np.searchsorted(self.scan_index, scans), 0, max(len(self) - 1, 0))

    def at_stamps(self, stamps_ns: I8) -> I8:
        """Rows of the scans (n,) at these times, or the first after."""
        return np.clip(np.searchsorted(self.stamp_ns, stamps_ns), 0, max(len(self) - 1, 0))

    def told(self, rows: I8) -> list[list[Any]]:
        """Number and time since `start_s` of scans, as each point of a curve carries them; the page adds the start."""
        seconds = fixed((self.stamp_ns[rows] - self.stamp_ns[0]) * 1e-9, 2)
        return [list(pair) for pair in zip(self.scan_index[rows].tolist(), seconds)]


def ways(poses: Mapping[str, Poses], odometries: Mapping[str, Odometry]) -> dict[str, Way]:
    """By the map's poses; by odometry for sessions that have none."""
    most = min(max(_MOST_OF_ALL // max(len(poses), 1), _LEAST_POINTS), MOST_POINTS)
    found = {name: _way(rows, rows.T_world_lidar, most) for name, rows in poses.items() if len(rows)}
    for name, rows in odometries.items():
        if name not in found and len(rows):
            found[name] = _way(rows, rows.T_odom_lidar, most)
    return dict(sorted(found.items()))


def _way(rows: Poses | Odometry, T: F8, most: int) -> Way:
    return Way(rows.scan_index, rows.stamp_ns, travelled(T), T[:, :3, 3], most)


HOVER = "%{y:.3~g} UNIT<br>%{x:.1f} m driven, scan %{customdata[0]}<br>stamp %{customdata[1]:.2f} s<extra></extra>"


def curve(label: str, way: Way, rows: I8, y: F8, colour: str, unit: str, **more: Any) -> Trace:
    """Values y (n,) of scans of a way, thinned; hovering tells distance, scan and stamp."""
    kept = thin(y, way.most)
    at = rows[kept]
    return {
        "type": "scatter", "mode": "lines", "name": label, "x": fixed(way.driven_m[at]), "y": short(y[kept]),
        "customdata": way.told(at), "meta": {"start_s": way.start_s}, "line": {"color": colour, "width": 1.6}, "hovertemplate": HOVER.replace("UNIT", unit),
        "showlegend": True, **more,
    }  # fmt: skip
