"""What is in the air: dust, snow, rain, spray.

Evidence of three kinds is added up, each as the logarithm of how much more often it is met with particles than with
solid things: a return weaker than those of solid things at its range; a place off the surfaces around it (methods 1.5.3;
DROR, Charron et al. 2018, counts neighbours likewise); and neighbouring scans that do not meet it again, or look through
it. Then what the points next to it say counts, and how much there is in the air at all. What neighbouring scans confirm,
or what they cannot say anything about, is never airborne.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.denoise.weights import CONTEXT, FIRST, FIRST_START, LAST, LAST_START, PRIOR
from scanloom.stages.denoise.window import Moment, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import elevation_bin, turn_of
from scanloom.stages.geometry.se3 import F8, inverse

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

GROUND, EGO, OUT_OF_RANGE = int(PointClass.GROUND), int(PointClass.EGO), int(PointClass.OUT_OF_RANGE)
NEAR, FAR = (-2, -1, 1, 2), (-8, -5, 5, 8)
"""Scans that are asked whether a point is still there."""


BAND_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
LEAST_IN_BAND = 100
STRENGTH_EDGES = np.array([0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.13, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
BEND_EDGES = np.array([0.3, 0.6, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 50.0])
COUNT_EDGES = np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0])
RANGE_EDGES_M = np.array([3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 25.0, 30.0, 40.0, 60.0])
BAND_OF_RANGE = np.array([0, 0, 1, 1, 2, 2, 3, 3, 3, 4, 4])
LOOKED_THROUGH = 6
CONTEXT_EDGES = np.array([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
AMONG_EDGES = np.array([1.0, 3.0, 6.0, 10.0])

STRENGTH, BEND, COUNT, RANGE, ON_GROUND, MET_NEAR, MET_FAR, THROUGH_NEAR, THROUGH_FAR = range(9)
KINDS, MOST_BINS = 9, 16
UNKNOWN = MOST_BINS - 1
"""Bin of a strength that the sensor does not tell."""
LIMIT = 6.0
"""A single look is trusted no more than this log-odds."""


def evidence(moment: Moment) -> U1:
    """Bin (n, KINDS) of each kind of evidence for each point."""
    view = moment.view
    found = np.zeros((len(view.scan), KINDS), np.uint8)
    own_evidence(view, found)
    ask(moment, np.flatnonzero(view.image.cell >= 0), found)
    return found


def own_evidence(view: View, found: U1) -> None:
    """What the scan itself tells: strength of the return, how far off the surfaces around it, neighbours, range."""
    scan, image = view.scan, view.image
    bend = _look(image.cell, view.classes, image.range_m, scan.x_m, scan.y_m, scan.z_m, found)
    usual = usual_strength(view, bend)
    if usual is None:
        found[:, STRENGTH] = UNKNOWN
    else:
        _strength(image.cell, scan.intensity, found, usual)


def usual_strength(view: View, bend: F4) -> F8 | None:
    """Median intensity (bands,) of what is solid and upright, by range; None when the sensor tells no intensities."""
    solid = np.flatnonzero((bend < 1.0) & (view.classes == PointClass.STATIC))
    intensity = view.scan.intensity[solid]
    known = np.isfinite(intensity)
    solid, intensity = solid[known], intensity[known]
    if len(solid) < LEAST_IN_BAND or np.ptp(intensity) == 0.0:
        return None
    band = np.searchsorted(BAND_EDGES_M, view.image.range_m.ravel()[view.image.cell[solid]])
    overall = float(np.median(intensity))
    out = np.full(len(BAND_EDGES_M) + 1, overall)
    for k in range(len(out)):
        inside = intensity[band == k]
        if len(inside) >= LEAST_IN_BAND:
            out[k] = np.median(inside)
    return out if overall > 0.0 else None


def ask(moment: Moment, asked: NDArray[np.int64], found: U1) -> None:
    """What the neighbouring scans tell of the points `asked`: how many met them again, how many saw through them."""
    scan = moment.view.scan
    for offsets, met, through in ((NEAR, MET_NEAR, THROUGH_NEAR), (FAR, MET_FAR, THROUGH_FAR)):
        known = moment.known(*offsets)
        votes = np.zeros((len(asked), 2), np.uint8)
        for view, T_scan_neighbour in known:
            _ask(
                scan.x_m,
                scan.y_m,
                scan.z_m,
                asked,
                inverse(T_scan_neighbour).astype(np.float32),
                view.image.range_m,
                view.image.row_of_bin,
                votes,
            )
        share = np.rint(4.0 * votes / max(len(known), 1)).astype(np.uint8)
        found[asked, met], found[asked, through] = share[:, 0], share[:, 1]


@kernel
def _bin_of(value: float, edges: F8) -> int:
    k = 0
    while k < len(edges) and value >= edges[k]:
        k += 1
    return k


@kernel
def _look(cell: I4, classes: U1, ranges: F4, x: F4, y: F4, z: F4, found: U1) -> F4:
    """Bins of bend, neighbours, range; returns the bend (n,): how far a point is off the line between two neighbours, in noise."""
    rows, columns = ranges.shape
    bend = np.full(len(cell), np.float32(np.inf))
    for n in range(len(cell)):
        if cell[n] < 0:
            continue
        v, u = cell[n] // columns, cell[n] % columns
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        best = 1e9
        for k in range(5):
            dv, du = (0, 0, 1, 1, 1)[k], (1, 2, 0, 1, -1)[k]
            if v - dv < 0 or v + dv >= rows:
                continue
            a, b = ranges[v + dv, (u + du) % columns], ranges[v - dv, (u - du) % columns]
            if a > 0.0 and b > 0.0:
                best = min(best, abs(2.0 * a * b / (a + b) - r))  # planes are straight in 1 / range
        bend[n] = best / (0.05 + 0.005 * r)
        tolerance = max(0.3, 0.02 * r)
        count = 0
        for dv in range(-1, 2):
            if v + dv < 0 or v + dv >= rows:
                continue
            for du in range(-2, 3):
                a = ranges[v + dv, (u + du) % columns]
                count += (dv != 0 or du != 0) and a > 0.0 and abs(a - r) < tolerance
        found[n, BEND] = _bin_of(bend[n], BEND_EDGES)
        found[n, COUNT] = _bin_of(count, COUNT_EDGES)
        found[n, RANGE] = _bin_of(r, RANGE_EDGES_M)
        found[n, ON_GROUND] = classes[n] == GROUND
    return bend


@kernel
def _strength(cell: I4, intensity: F4, found: U1, usual: F8) -> None:
    for n in range(len(cell)):
        if cell[n] >= 0:
            band = found[n, RANGE]
            found[n, STRENGTH] = _bin_of(intensity[n] / usual[BAND_OF_RANGE[band]], STRENGTH_EDGES)


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
        for dv in range(-1, 2):
            if v + dv < 0 or v + dv >= rows:
                continue
            for du in range(-1, 2):
                w = u + du
                w = w + columns if w < 0 else (w - columns if w >= columns else w)
                a = ranges[v + dv, w]
                met = met or abs(a - r) < same
                behind += a == 0.0 or a > r + beyond
        votes[m, 0] += met
        votes[m, 1] += behind >= LOOKED_THROUGH


@kernel
def _sum(found: U1, asked: I8, weights: F8, start: float) -> F4:
    """Log-odds (m,) of the rows `asked`."""
    out = np.empty(len(asked), np.float32)
    for m in range(len(asked)):
        total = start
        for k in range(found.shape[1]):
            total += weights[k, found[asked[m], k]]
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
        r = np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n])
        near2 = (0.6 + 0.03 * r) ** 2
        total, count = 0.0, 0
        for dv in range(-1, 2):
            if v + dv < 0 or v + dv >= rows:
                continue
            for du in range(-4, 5):
                w = u + du
                w = w + columns if w < 0 else (w - columns if w >= columns else w)
                j = point[v + dv, w]
                if j < 0 or j == n:
                    continue
                if (x[j] - x[n]) ** 2 + (y[j] - y[n]) ** 2 + (z[j] - z[n]) ** 2 < near2:
                    total += min(max(odds[j], -LIMIT), LIMIT)
                    count += 1
        if count:
            out[m] = (
                1
                + _bin_of(total / count, CONTEXT_EDGES) * (len(AMONG_EDGES))
                + min(_bin_of(float(count), AMONG_EDGES) - 1, len(AMONG_EDGES) - 1)
            )
    return out


LEAST_ODDS = -3.5
"""Points below this after the scan's own evidence are not asked about: neighbouring scans add no more than 3."""


def airborne(moment: Moment) -> B1:
    """Which points (n,) of the present scan are in the air; none where no neighbouring scan can be asked."""
    view, scan = moment.view, moment.view.scan
    out = np.zeros(len(scan), np.bool_)
    if not moment.known(*NEAR) or not (view.image.cell >= 0).any():
        return out
    found = np.zeros((len(scan), KINDS), np.uint8)
    own_evidence(view, found)
    drawn = np.flatnonzero(view.image.cell >= 0)
    odds = np.full(len(scan), -LIMIT, np.float32)
    odds[drawn] = _sum(found, drawn, FIRST, FIRST_START)
    asked = drawn[odds[drawn] > LEAST_ODDS]
    ask(moment, asked, found)
    odds[asked] = _sum(found, asked, FIRST, FIRST_START)
    around = context(view.image.cell, view.image.point, scan.x_m, scan.y_m, scan.z_m, asked, odds)
    last = _sum(found, asked, LAST, LAST_START) + CONTEXT[around]
    out[asked] = last + _shift(last, len(drawn)) > 0.0
    return out


def _shift(odds: F8, points: int) -> float:
    """What to add to all log-odds for the share of particles in this very scan, found with it (expectation, maximisation)."""
    usual, shift = np.log(PRIOR / (1.0 - PRIOR)), 0.0
    for _ in range(6):
        share = np.clip((1.0 / (1.0 + np.exp(-(odds + shift)))).sum() / points, 1e-5, 0.5)
        shift = float(np.log(share / (1.0 - share)) - usual)
    return shift
