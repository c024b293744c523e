"""What is in the air: dust, snow, rain, spray.

Evidence is added up, each kind as the log-odds it gives of a particle against something solid: a return weaker than those
of solid things at its range; a place off the surfaces around it, with few neighbours (the idea of DROR, Charron et al.
2018); neighbouring scans that do not meet it again or look through it (methods 1.5.3). Then the points around it are heard,
and how much there is in the air at all. What neighbouring scans cannot be asked about is never airborne.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.denoise import weights
from scanloom.stages.denoise.window import Moment, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import elevation_bin, turn_of
from scanloom.stages.geometry.se3 import F8, inverse

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

GROUND, STATIC = int(PointClass.GROUND), int(PointClass.STATIC)
NEAR, FAR = (-2, -1, 1, 2), (-8, -5, 5, 8)
"""Scans that are asked whether a point is still there."""

STRENGTH, SHAPE, RANGE, ON_GROUND, AGAIN_NEAR, AGAIN_FAR = range(6)
KINDS, MOST_BINS = 6, weights.BINS
STRENGTH_EDGES = np.array([0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.13, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
UNKNOWN = MOST_BINS - 1
"""Bin of a strength that the sensor does not tell."""
MOST_LINES, FAR_OFF = 4, 5.0
COUNT_EDGES = np.array([1.0, 2.0, 4.0, 8.0])
SURFACE = (MOST_LINES + 2) * (len(COUNT_EDGES) + 1) - 1
"""Bin of the shape of a point on a surface."""
SOLID = MOST_BINS - 1
"""Bin of the shape of points that are not looked at, since they are solid by other evidence."""
RANGE_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
NOT_ASKED = 25
"""Bin of what scans say that are not there."""
CONTEXT_EDGES = np.array([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
AMONG_EDGES = np.array([3.0, 6.0, 10.0])

SAMPLED = 4
LEAST_IN_BAND = 100
BRIGHT, BRIGHTER = 0.8, 12
"""Quantile of the intensities of solid things that strengths are relative to, and the bin that no particle reaches."""
DIMMEST = 0.7
"""A range whose solid things seem dimmer than this share of those at the brightest range is full of dust."""
COMMON, COMMON_BINS = (0.03, 0.08, 0.15, 0.25), (4, 7, 9, 11)
"""An intensity that this share of solid points stay below is at least in this bin."""
ROUNDED, SAYS_NOTHING = 0.01, 9
"""When more than this share of solid points have the very lowest intensity, it is at least in this bin."""
LOOKED_THROUGH = 6
"""Cells of nine around a place that show nothing, or something behind it."""
LIMIT = 6.0
"""A single look is trusted no more than this log-odds."""
MOST_SHIFT, CLEAR_AIR = 1.0, 0.4
STEPS, LEAST_SHARE, MOST_ODDS = 6, 1e-5, 30.0
LEAST_ODDS = -3.0
"""Neighbouring scans are not asked about points below this, nor are their surroundings: they cannot make up for it."""


def airborne(moment: Moment) -> B1:
    """Which points (n,) of the present scan are in the air; none where no neighbouring scan can be asked."""
    view, scan = moment.view, moment.view.scan
    out = np.zeros(len(scan), np.bool_)
    drawn = np.flatnonzero(view.image.cell >= 0)
    if not moment.known(*NEAR) or not len(drawn):
        return out
    found = own_evidence(view)
    odds = np.full(len(scan), -LIMIT, np.float32)
    odds[drawn] = log_odds(found, drawn, weights.FIRST)
    asked = drawn
    for offsets, kind in ((NEAR, AGAIN_NEAR), (FAR, AGAIN_FAR)):
        asked = asked[odds[asked] > LEAST_ODDS]
        ask(moment, offsets, kind, asked, found)
        odds[asked] = log_odds(found, asked, weights.FIRST)
    around = context(view.image.cell, view.image.point, scan.x_m, scan.y_m, scan.z_m, asked, odds)
    flake = log_odds(found, asked, weights.FLAKE) + weights.CONTEXT_FLAKE[around]
    cloud = log_odds(found, asked, weights.CLOUD) + weights.CONTEXT_CLOUD[around]
    by_flakes, by_clouds = shifts(flake, cloud, len(drawn))
    out[asked] = np.logaddexp(flake + by_flakes, cloud + by_clouds) > 0.0
    return out


def met_again(moment: Moment, asked: I8) -> B1:
    """Which of the points `asked` (m,) a neighbouring scan has a point near, too; none when no scan can be asked."""
    found = np.zeros((len(moment.view.scan), KINDS), np.uint8)
    out = np.zeros(len(asked), np.bool_)
    for offsets, kind in ((NEAR, AGAIN_NEAR), (FAR, AGAIN_FAR)):
        ask(moment, offsets, kind, asked, found)
        out |= (found[asked, kind] >= 5) & (found[asked, kind] < NOT_ASKED)
    return out


def own_evidence(view: View) -> U1:
    """Bins (n, KINDS) of what the scan itself tells; nothing yet of AGAIN_NEAR and AGAIN_FAR."""
    scan, image = view.scan, view.image
    found = np.zeros((len(scan), KINDS), np.uint8)
    drawn = np.flatnonzero(image.cell >= 0)
    some = np.flatnonzero((image.cell >= 0) & (view.classes == STATIC))[::SAMPLED]
    _look(image.cell, image.range_m, scan.x_m, scan.y_m, scan.z_m, some, found)
    edges = strength_edges(view, some, found)
    unclear = _sift(
        image.cell, image.range_m, view.classes, scan.x_m, scan.y_m, scan.z_m, scan.intensity, drawn,
        np.zeros((0, 0)) if edges is None else edges, found,
    )  # fmt: skip
    _look(image.cell, image.range_m, scan.x_m, scan.y_m, scan.z_m, unclear, found)
    return found


def strength_edges(view: View, some: I8, found: U1) -> F8 | None:
    """Intensities (bands, edges) between the bins of strength, by range; None when the sensor tells none, or nothing
    solid is near.

    They are relative to bright solid things. But an intensity that many solid points have, such as 0 from a sensor that
    rounds, says nothing of particles.
    """
    intensity, shape = view.scan.intensity[some], found[some, SHAPE]
    solid = (shape == SURFACE) & np.isfinite(intensity)
    intensity, band = intensity[solid], _bands(view, some[solid])
    if len(intensity) < LEAST_IN_BAND or np.ptp(intensity) == 0.0:
        return None
    faintest = intensity.min()
    rounded = float(np.mean(intensity == faintest)) > ROUNDED
    bright = np.full(len(RANGE_EDGES_M) + 1, float(np.quantile(intensity, BRIGHT)))
    for k in range(len(bright)):
        inside = intensity[band == k]
        if len(inside) >= LEAST_IN_BAND:
            bright[k] = np.quantile(inside, BRIGHT)
    bright = np.maximum(bright, DIMMEST * bright.max())
    if bright.max() <= 0.0:
        return None
    common = np.quantile(intensity, COMMON)
    out: F8 = bright[:, None] * STRENGTH_EDGES
    for k in range(len(out)):
        for at, limit in zip(COMMON_BINS, common, strict=True):
            out[k, :at] = np.minimum(out[k, :at], limit)
        if rounded:
            out[k, :SAYS_NOTHING] = np.minimum(out[k, :SAYS_NOTHING], faintest)
    return out


def _bands(view: View, rows: I8) -> I8:
    x, y, z = view.scan.x_m[rows], view.scan.y_m[rows], view.scan.z_m[rows]
    bands: I8 = np.searchsorted(RANGE_EDGES_M, np.sqrt(x * x + y * y + z * z), side="right")
    return bands


def ask(moment: Moment, offsets: tuple[int, ...], kind: int, asked: I8, found: U1) -> None:
    """What scans at `offsets` tell of the points `asked`: in how many of four they are met again, and seen through."""
    scan, known = moment.view.scan, moment.known(*offsets)
    votes = np.zeros((len(asked), 2), np.uint8)
    for view, T_scan_neighbour in known:
        T = inverse(T_scan_neighbour).astype(np.float32)
        _ask(scan.x_m, scan.y_m, scan.z_m, asked, T, view.image.range_m, view.image.row_of_bin, votes)
    share = np.rint(4.0 * votes / max(len(known), 1)).astype(np.uint8)
    found[asked, kind] = 5 * share[:, 0] + share[:, 1] if known else NOT_ASKED


def shifts(flake: F8, cloud: F8, points: int) -> tuple[float, float]:
    """What the shares of flakes and of clouds in this very scan add to their log-odds; the shares are found with it.

    Expectation and maximisation of a mixture's weights, solid things being the third. In clear air not all of it counts,
    since particles keep to places.
    """
    usual = np.log(weights.SHARES / (1.0 - weights.SHARES))
    odds, shift = np.stack((flake, cloud)), np.zeros(2)
    for _ in range(STEPS):
        risen = np.exp(np.clip(odds + shift[:, None], -MOST_ODDS, MOST_ODDS))
        share = np.clip((risen / (1.0 + risen.sum(axis=0))).sum(axis=1) / points, LEAST_SHARE, 0.5)
        shift = np.log(share / (1.0 - share)) - usual
    capped = np.where(shift > 0.0, np.minimum(shift, MOST_SHIFT), CLEAR_AIR * shift)
    return float(capped[0]), float(capped[1])


@kernel
def _bin_of(value: float, edges: F8) -> int:
    k = 0
    while k < len(edges) and value >= edges[k]:
        k += 1
    return k


@kernel
def _sift(
    cell: I4, ranges: F4, classes: U1, x: F4, y: F4, z: F4, intensity: F4, drawn: I8, edges: F8, found: U1
) -> I8:
    """Bins of strength, range, ground; returns the points that are neither as bright as no particle is, nor flat ground."""
    columns = ranges.shape[1]
    out, kept = np.empty(len(drawn), np.int64), 0
    for n in drawn:
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        band = _bin_of(r, RANGE_EDGES_M)
        found[n, RANGE], found[n, ON_GROUND] = band, classes[n] == GROUND
        found[n, STRENGTH] = _bin_of(intensity[n], edges[band]) if len(edges) else UNKNOWN
        solid = len(edges) > 0 and found[n, STRENGTH] >= BRIGHTER
        if not solid and classes[n] == GROUND:
            v, u = cell[n] // columns, cell[n] % columns
            off = _bend(ranges[v, _turned(u + 1, columns)], ranges[v, _turned(u - 1, columns)], r)
            solid = off < 0.05 + 0.005 * r
        if solid:
            found[n, SHAPE] = SOLID
        else:
            out[kept] = n
            kept += 1
    return out[:kept].copy()


@kernel
def _look(cell: I4, ranges: F4, x: F4, y: F4, z: F4, asked: I8, found: U1) -> None:
    """Bin of shape of the points `asked`: on how many lines between opposite neighbours they lie, how many are near."""
    rows, columns = ranges.shape
    for n in asked:
        v, u = cell[n] // columns, cell[n] % columns
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        noise, tolerance = 0.05 + 0.005 * r, max(0.3, 0.02 * r)
        low, high = max(v - 1, 0), min(v + 1, rows - 1)
        bend, straight, count = 1e9, 0, -1
        for du in range(-2, 3):
            w, opposite = _turned(u + du, columns), _turned(u - du, columns)
            for i in range(low, high + 1):
                a = ranges[i, w]
                count += a > 0.0 and abs(a - r) < tolerance
            if du > 0:
                off = _bend(ranges[v, w], ranges[v, opposite], r)
                bend, straight = min(bend, off), straight + (off < noise)
            if abs(du) < 2 and low < v < high:
                off = _bend(ranges[low, w], ranges[high, opposite], r)
                bend, straight = min(bend, off), straight + (off < noise)
        lines = 1 + min(straight, MOST_LINES) if bend < FAR_OFF * noise else 0
        found[n, SHAPE] = lines * (len(COUNT_EDGES) + 1) + _bin_of(float(count), COUNT_EDGES)


@kernel
def _turned(column: int, columns: int) -> int:
    if column < 0:
        return column + columns
    return column - columns if column >= columns else column


@kernel
def _bend(a: float, b: float, r: float) -> float:
    """How far range `r` is off the line between its neighbours `a` and `b`: planes are straight in 1 / range."""
    return abs(2.0 * a * b / (a + b) - r) if a > 0.0 and b > 0.0 else 1e9


@kernel
def _ask(x: F4, y: F4, z: F4, asked: I8, T: F4, ranges: F4, row_of_bin: I4, votes: U1) -> None:
    """Adds one to votes (m, 2) of the points met again, and of those looked through, in one neighbouring scan."""
    rows, columns = ranges.shape
    for m in range(len(asked)):
        n = asked[m]
        px = T[0, 0] * x[n] + T[0, 1] * y[n] + T[0, 2] * z[n] + T[0, 3]
        py = T[1, 0] * x[n] + T[1, 1] * y[n] + T[1, 2] * z[n] + T[1, 3]
        pz = T[2, 0] * x[n] + T[2, 1] * y[n] + T[2, 2] * z[n] + T[2, 3]
        level = np.sqrt(px * px + py * py)
        r = np.sqrt(level * level + pz * pz)
        v = row_of_bin[elevation_bin(level, pz)]
        u = min(int(turn_of(px, py) * np.float32(columns)), columns - 1)
        same, beyond = 0.2 + 0.01 * r, 0.3 + 0.02 * r
        met, behind = False, 0
        for i in range(max(v - 1, 0), min(v + 2, rows)):
            for du in range(-1, 2):
                a = ranges[i, _turned(u + du, columns)]
                met = met or abs(a - r) < same
                behind += a == 0.0 or a > r + beyond
        votes[m, 0] += met
        votes[m, 1] += behind >= LOOKED_THROUGH


@kernel
def log_odds(found: U1, asked: I8, table: F8) -> F4:
    """Sum (m,) of what each kind of evidence says of the rows `asked`; the table (KINDS + 1, MOST_BINS) ends with a constant."""
    out = np.empty(len(asked), np.float32)
    for m in range(len(asked)):
        total = table[KINDS, 0]
        for k in range(KINDS):
            total += table[k, found[asked[m], k]]
        out[m] = total
    return out


@kernel
def context(cell: I4, point: I4, x: F4, y: F4, z: F4, asked: I8, odds: F4) -> U1:
    """Bin (m,) of what the points around each of those `asked` say: their mean log-odds, and how many they are."""
    rows, columns = point.shape
    out = np.zeros(len(asked), np.uint8)
    for m in range(len(asked)):
        n = asked[m]
        v, u = cell[n] // columns, cell[n] % columns
        near = 0.6 + 0.03 * np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        total, count = 0.0, 0
        for i in range(max(v - 1, 0), min(v + 2, rows)):
            for du in range(-4, 5):
                j = point[i, _turned(u + du, columns)]
                if j < 0 or j == n:
                    continue
                if (x[j] - x[n]) ** 2 + (y[j] - y[n]) ** 2 + (z[j] - z[n]) ** 2 < near * near:
                    total += min(max(odds[j], -LIMIT), LIMIT)
                    count += 1
        if count > 0:
            said = _bin_of(total / count, CONTEXT_EDGES)
            out[m] = 1 + said * (len(AMONG_EDGES) + 1) + _bin_of(float(count), AMONG_EDGES)
    return out
