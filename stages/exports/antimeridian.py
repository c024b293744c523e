"""Lines and areas that cross the 180th meridian, as RFC 7946 (sections 3.1.9 and 5.2) wants them.

Longitudes are unrolled around a first one, so that neighbours are near each other as numbers, then cut at 180 degrees.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scanloom.stages.geometry.se3 import F8

DATE_LINE_DEG = 180.0


def wrapped(longitude_deg: ArrayLike) -> F8:
    """The same longitudes in [-180, 180)."""
    longitude = np.asarray(longitude_deg, float)
    return np.asarray(longitude - 360.0 * np.floor((longitude + DATE_LINE_DEG) / 360.0), float)


def unrolled(longitude_deg: ArrayLike) -> F8:
    """Longitudes (n,) without jumps: each within half a turn of the first, which is in [-180, 180)."""
    longitude = np.asarray(longitude_deg, float)
    if not len(longitude):
        return longitude
    return np.asarray(longitude - 360.0 * np.round((longitude - wrapped(longitude[0])) / 360.0), float)


def cut_line(positions: ArrayLike) -> list[F8]:
    """Pieces of a line (n, k) of (longitude, latitude, ...), each on one side of the 180th meridian.

    Where the line crosses it, both pieces end in the crossing point, once as 180 and once as -180 degrees.
    """
    line = np.array(positions, float)
    line[:, 0] = unrolled(line[:, 0])
    turn = np.floor((line[:, 0] + DATE_LINE_DEG) / 360.0)
    pieces: list[F8] = []
    begin = 0
    head = np.empty((0, line.shape[1]))
    for i in np.flatnonzero(np.diff(turn)).tolist():
        crossing = _crossing(line[i], line[i + 1], 360.0 * max(turn[i], turn[i + 1]) - DATE_LINE_DEG)
        pieces.append(_moved(np.vstack((head, line[begin : i + 1], crossing)), turn[i]))
        head, begin = crossing, i + 1
    pieces.append(_moved(np.vstack((head, line[begin:])), turn[-1]))
    return pieces


def cut_convex(ring: ArrayLike) -> list[F8]:
    """Rings, closed, that cover a convex area (n, 2) of (longitude, latitude) given by its corners in order."""
    corners = np.array(ring, float)
    corners[:, 0] = unrolled(corners[:, 0])
    turns = np.unique(np.floor((corners[:, 0] + DATE_LINE_DEG) / 360.0))
    if len(turns) == 1:
        return [_closed(_moved(corners, turns[0]))]
    at = 360.0 * turns[-1] - DATE_LINE_DEG
    halves = ((_clipped(corners, at, -1.0), turns[0]), (_clipped(corners, at, 1.0), turns[-1]))
    return [_closed(_moved(half, turn)) for half, turn in halves if len(half) > 2]


def bounding_box(positions: ArrayLike) -> list[float]:
    """West, south(, lowest), east, north(, highest) of positions (n, 2 or 3); west > east across the 180th meridian."""
    p = np.array(positions, float)
    p[:, 0] = unrolled(p[:, 0])
    low, high = p.min(axis=0), p.max(axis=0)
    low[0] = wrapped(low[0])
    if high[0] != DATE_LINE_DEG:
        high[0] = wrapped(high[0])
    return [float(v) for v in (*low, *high)]


def line_geometry(positions: ArrayLike) -> dict[str, Any] | None:
    """GeoJSON geometry of a track: None, a Point, a LineString, or a MultiLineString when it is cut."""
    line = np.asarray(positions, float)
    if not len(line):
        return None
    if len(line) == 1:
        return {"type": "Point", "coordinates": [float(wrapped(line[0, 0])), *line[0, 1:].tolist()]}
    pieces = [piece.tolist() for piece in cut_line(line)]
    if len(pieces) == 1:
        return {"type": "LineString", "coordinates": pieces[0]}
    return {"type": "MultiLineString", "coordinates": pieces}


def area_geometry(ring: ArrayLike) -> dict[str, Any]:
    """GeoJSON geometry of a convex area, corners counter-clockwise: a Polygon, or a MultiPolygon when it is cut."""
    rings = [piece.tolist() for piece in cut_convex(ring)]
    if len(rings) == 1:
        return {"type": "Polygon", "coordinates": rings}
    return {"type": "MultiPolygon", "coordinates": [[piece] for piece in rings]}


def _crossing(a: F8, b: F8, longitude_deg: float) -> F8:
    """(1, k): where the way from a to b meets a meridian, on a straight line of longitude and latitude."""
    along = (longitude_deg - a[0]) / (b[0] - a[0])
    point = np.asarray(a + along * (b - a), float)
    point[0] = longitude_deg
    return point[None]


def _moved(piece: F8, turn: float) -> F8:
    """A piece of turn number `turn` with longitudes in [-180, 180]."""
    piece = piece.copy()
    piece[:, 0] -= 360.0 * turn
    return piece


def _closed(ring: F8) -> F8:
    return np.vstack((ring, ring[:1]))


def _clipped(ring: F8, longitude_deg: float, side: float) -> F8:
    """Corners of a convex area on one side of a meridian (Sutherland and Hodgman 1974)."""
    kept: list[F8] = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        da, db = side * (a[0] - longitude_deg), side * (b[0] - longitude_deg)
        if da >= 0.0:
            kept.append(a)
        if da * db < 0.0:
            kept.append(_crossing(a, b, longitude_deg)[0])
    return np.array(kept).reshape(-1, ring.shape[1])
