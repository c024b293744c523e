"""Where the vehicle drives, and how fast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.terrain import (
    BRIDGE_X,
    EAST_X,
    LANE_M,
    NORTH_Y,
    PLATEAU_Y,
    ROUNDABOUT,
    ROUNDABOUT_R,
    Plan,
    Terrain,
    deck_height,
)

SAMPLE_M = 0.25
TRACK_M = 0.8
TICK_S = 0.02
ACCEL_M_S2, BRAKE_M_S2, LATERAL_M_S2, TOWN_SPEED_M_S = 1.6, 1.9, 2.3, 9.0
MARGIN_S = 6.0
"""The drive is computed this much beyond the end of the log, for followers and filters."""


@dataclass(frozen=True)
class Path:
    """A closed smooth curve of known length with the height and cross slope of the road under it."""

    length_m: float
    xyz: BSpline
    """Position (.., 3) by arc length, periodic."""
    cross_slope: BSpline
    """Slope towards the left, by arc length, periodic."""

    def at(self, s: F8, derivative: int = 0) -> F8:
        """Position (n, 3), or its derivative by arc length, at arc lengths of any lap."""
        out: F8 = self.xyz(np.mod(s, self.length_m), nu=derivative)
        return out

    def curvature(self, s: F8) -> F8:
        d1, d2 = self.at(s, 1), self.at(s, 2)
        speed = np.hypot(d1[:, 0], d1[:, 1])
        out: F8 = (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) / speed**3
        return out

    def heading(self, s: F8) -> F8:
        d = self.at(s, 1)
        return np.arctan2(d[:, 1], d[:, 0])

    def nearest(self, x: float, y: float) -> float:
        """First arc length that comes closest to a place."""
        s = np.arange(0, self.length_m, 0.5)
        p = self.at(s)
        return float(s[np.argmin(np.hypot(p[:, 0] - x, p[:, 1] - y))])


def town_lap(plan: Plan) -> F8:
    """Corners of the lap (n, 3): x, y and the radius of the turn, m. Traffic keeps to the right.

    Once round the block anticlockwise, South Street a second time, through the tunnel to the field, back over the
    plateau and the bridge, South Street westwards, and round the roundabout.
    """
    lane, cx, r = LANE_M, ROUNDABOUT[0], ROUNDABOUT_R
    angles = np.radians(np.arange(35, 326, 10))
    circle = np.column_stack((cx + r * np.cos(angles), r * np.sin(angles), np.zeros(len(angles))))
    corners = [
        [EAST_X + lane, -lane, 9], [EAST_X + lane, NORTH_Y + lane, 9], [-lane, NORTH_Y + lane, 9], [-lane, -lane, 9],
        [plan.field_x + lane, -lane, 31], [plan.field_x + lane, PLATEAU_Y + lane, 31], [BRIDGE_X - lane, PLATEAU_Y + lane, 10],
        [BRIDGE_X - lane, lane, 7], [-60, lane, 0],
    ]  # fmt: skip
    return np.vstack(([[-50.0, -lane, 0.0]], corners, circle, [[-60.0, -lane, 0.0]]))


def ring() -> F8:
    """The circle of the roundabout as corners."""
    angles = np.radians(np.arange(0, 360, 5))
    x, y = ROUNDABOUT
    r = ROUNDABOUT_R + 0.3
    return np.column_stack((x + r * np.cos(angles), y + r * np.sin(angles), np.zeros(len(angles))))


def rounded(corners: F8, closed: bool = True) -> F8:
    """Points (n, 2) every SAMPLE_M along straight lines whose corners are replaced by arcs."""
    pieces: list[F8] = []
    n = len(corners)
    for i, (x, y, radius) in enumerate(corners):
        corner = np.array([x, y])
        if radius == 0 or (not closed and i in (0, n - 1)):
            pieces.append(corner[None])
            continue
        a, b = corners[i - 1, :2] - corner, corners[(i + 1) % n, :2] - corner
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        half = np.arccos(np.clip(a @ b, -1, 1)) / 2
        bisector = (a + b) / np.linalg.norm(a + b)
        centre = corner + bisector * radius / np.sin(half)
        start, end = (np.arctan2(*(corner + v * radius / np.tan(half) - centre)[::-1]) for v in (a, b))
        sweep = np.mod(end - start + np.pi, 2 * np.pi) - np.pi
        angle = start + sweep * np.linspace(0, 1, 24)
        pieces.append(centre + radius * np.column_stack((np.cos(angle), np.sin(angle))))
    line = np.concatenate([*pieces, pieces[0][:1]] if closed else pieces)
    reach = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    s = np.linspace(0, reach[-1], int(reach[-1] / SAMPLE_M), endpoint=not closed)
    return np.column_stack((np.interp(s, reach, line[:, 0]), np.interp(s, reach, line[:, 1])))


def build_path(corners: F8, terrain: Terrain) -> Path:
    """Smooth closed path over the built ground, and over a bridge where there is one."""
    xy = gaussian_filter1d(rounded(corners), 2.4 / SAMPLE_M, axis=0, mode="wrap")
    step = np.hypot(*(np.roll(xy, -1, 0) - xy).T)
    s = np.concatenate(([0.0], np.cumsum(step)))
    length = float(s[-1])
    even = np.arange(0, length, 1.0)
    even = np.linspace(0, length, len(even) + 1)
    curve = _periodic(s, np.vstack((xy, xy[:1])))
    p, d = curve(even[:-1]), curve(even[:-1], nu=1)
    normal = np.column_stack((-d[:, 1], d[:, 0])) / np.hypot(d[:, 0], d[:, 1])[:, None]
    bridge = terrain.plan.on_deck(p, d)
    left, right = (_surface(terrain, p + side * TRACK_M * normal, bridge) for side in (1, -1))
    z = gaussian_filter1d((left + right) / 2, 1.5, mode="wrap")
    slope = gaussian_filter1d((left - right) / (2 * TRACK_M), 1.5, mode="wrap")
    rows = np.column_stack((p, z))
    return Path(
        length, _periodic(even, np.vstack((rows, rows[:1]))), _periodic(even, np.append(slope, slope[0]))
    )


def _periodic(s: F8, values: F8) -> BSpline:
    return make_interp_spline(s, values, k=5 if values.ndim == 2 and len(s) < 4000 else 3, bc_type="periodic")


def _surface(terrain: Terrain, p: F8, bridge: NDArray[np.bool_]) -> F8:
    return np.where(bridge, deck_height(p[:, 0], p[:, 1]), terrain.height(p[:, 0], p[:, 1]))


def progress(settings: Settings, path: Path) -> tuple[F8, F8]:
    """Times (n,) s and arc lengths (n,) m of the drive every TICK_S, from MARGIN_S before the start to after the end."""
    limit = _speed_limit(settings, path)
    stops = _stops(settings, path)
    ticks = int(np.ceil((settings.duration_s + 2 * MARGIN_S) / TICK_S))
    speed = np.zeros(ticks)
    s, v, rest = settings.start_m, 0.0, MARGIN_S + settings.standstill_s
    for k in range(ticks):
        if rest > 0:
            rest -= TICK_S
            continue
        cap = limit[int(np.mod(s, path.length_m) / 0.5) % len(limit)]
        ahead = stops[0][0] - s if stops else np.inf
        v = min(v + ACCEL_M_S2 * TICK_S, cap, float(np.sqrt(2 * BRAKE_M_S2 * max(ahead - 0.2, 0.0))))
        if ahead < 0.6 and v < 0.7:
            v, rest = 0.0, stops.pop(0)[1]
        speed[k] = v
        s += v * TICK_S
    speed = gaussian_filter1d(speed, 0.35 / TICK_S, mode="nearest")
    t: F8 = -MARGIN_S + TICK_S * np.arange(ticks, dtype=float)
    return t, settings.start_m + np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2))) * TICK_S


def _speed_limit(settings: Settings, path: Path) -> F8:
    """Speed (n,) m/s every half metre of the lap that bends, brakes and the town allow."""
    s = np.arange(0, path.length_m, 0.5)
    p = path.at(s)
    bends = np.sqrt(LATERAL_M_S2 / np.maximum(np.abs(path.curvature(s)), 1e-3))
    town = (settings.route == "estate") | ((p[:, 0] < 112) & (p[:, 1] < 140))
    v = np.minimum(bends, np.where(town, min(TOWN_SPEED_M_S, settings.top_speed_m_s), settings.top_speed_m_s))
    for k in range(2 * len(v) - 1, 0, -1):
        i = k % len(v)
        v[i - 1] = min(v[i - 1], np.sqrt(v[i] ** 2 + 2 * BRAKE_M_S2 * 0.5))
    return v


def light_arc(path: Path) -> float:
    """Where the vehicle waits at the light on South Street, m."""
    return path.nearest(77.0, -LANE_M)


def _stops(settings: Settings, path: Path) -> list[tuple[float, float]]:
    """Arc length and time of rest: the light on South Street on the first pass, and where the bridge street ends."""
    if settings.route != "town":
        return []
    light, give_way = light_arc(path), path.nearest(BRIDGE_X - LANE_M, 11.0)
    laps = int((settings.start_m + settings.duration_s * settings.top_speed_m_s) / path.length_m) + 2
    stops = [
        (lap * path.length_m + s, rest) for lap in range(laps) for s, rest in ((light, 6.0), (give_way, 3.0))
    ]
    return [stop for stop in stops if stop[0] > settings.start_m + 8]
