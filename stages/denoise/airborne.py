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
from scanloom.stages.denoise.frame import places_from, taken
from scanloom.stages.denoise.window import Moment, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.geometry.voxels import Float

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
RANGE_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
NOT_ASKED = 25
"""Bin of what scans say that are not there."""
CONTEXT_EDGES = np.array([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
AMONG_EDGES = np.array([3.0, 6.0, 10.0])

SAMPLED, SAMPLES = 4, 6_000
"""Of so many solid points one is looked at for its intensity; of fewer where a scan has more points than so many times that."""
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
NOISE_M, NOISE_PER_M, NEAR_M, NEAR_PER_M = (np.float32(c) for c in (0.05, 0.005, 0.3, 0.02))
"""A point lies on a line if it is off it by less than the noise; neighbours within the second pair are near."""
SAME_M, SAME_PER_M, BEYOND_M, BEYOND_PER_M = (np.float32(c) for c in (0.2, 0.01, 0.3, 0.02))
"""A neighbouring scan meets a point again within the first pair; what it sees behind it is farther by the second."""
AMONG_M, AMONG_PER_M = np.float32(0.6), np.float32(0.03)
"""Points this near are heard."""
WHOLE = np.uint64
"""Of cells that are looked up: a signed number is asked each time whether it counts from the end."""
ZERO, TWICE, UNBENT = np.float32(0.0), np.float32(2.0), np.float32(1e9)
BANDS_M = tuple(np.float32(edge) for edge in RANGE_EDGES_M)
STEPS, LEAST_SHARE, MOST_ODDS = 6, 1e-5, 30.0
LEAST_ODDS = -2.5
"""Neighbouring scans are not asked about points below this, nor are their surroundings: they cannot make up for it."""


def airborne(moment: Moment) -> B1:
    """Which points (n,) of the present scan are in the air; none where no neighbouring scan can be asked."""
    view = moment.view
    out = np.zeros(len(view.scan), np.bool_)
    drawn = drawn_points(view.frame.place)
    if not moment.known(*NEAR) or not drawn:
        return out
    asked, found = own_evidence(view)
    odds = np.full(len(view.scan), -LIMIT, np.float32)
    odds[asked] = first = log_odds(found, weights.FIRST)
    for offsets, kind in ((NEAR, AGAIN_NEAR), (FAR, AGAIN_FAR)):
        left = first > LEAST_ODDS
        asked, found = asked[left], found[left]
        ask(moment, offsets, kind, asked, found)
        odds[asked] = first = log_odds(found, weights.FIRST)
    frame = view.frame
    around = context(
        frame.place, frame.point, frame.range_m, frame.stride, frame.away_m, view.scan.x_m, view.scan.y_m, view.scan.z_m,
        asked, odds,
    )  # fmt: skip
    flake = log_odds(found, weights.FLAKE) + weights.CONTEXT_FLAKE[around]
    cloud = log_odds(found, weights.CLOUD) + weights.CONTEXT_CLOUD[around]
    by_flakes, by_clouds = shifts(flake, cloud, drawn)
    out[asked] = np.logaddexp(flake + by_flakes, cloud + by_clouds) > 0.0
    return out


def met_again(moment: Moment, asked: I8) -> B1:
    """Which of the points `asked` (m,) a neighbouring scan has a point near, too; none when no scan can be asked."""
    found = np.zeros((len(asked), KINDS), np.uint8)
    out = np.zeros(len(asked), np.bool_)
    for offsets, kind in ((NEAR, AGAIN_NEAR), (FAR, AGAIN_FAR)):
        ask(moment, offsets, kind, asked, found)
        out |= (found[:, kind] >= 5) & (found[:, kind] < NOT_ASKED)
    return out


def own_evidence(view: View) -> tuple[I8, U1]:
    """Points (m,) that may be in the air, and bins (m, KINDS) of what the scan itself tells of them.

    Nothing yet of AGAIN_NEAR and AGAIN_FAR. The other points are as bright as no particle is, or flat ground.
    """
    frame = view.frame
    edges = strength_edges(view)
    unclear, found = _sift(
        frame.place, frame.away_m, frame.range_m, view.classes, view.scan.intensity,
        np.zeros((0, 0)) if edges is None else edges,
    )  # fmt: skip
    found[:, SHAPE] = _shapes(frame.place, frame.away_m, frame.range_m, frame.stride, unclear)
    return unclear, found


def strength_edges(view: View) -> F8 | None:
    """Intensities (bands, edges) between the bins of strength, by range; None when the sensor tells none, or nothing
    solid is near.

    They are relative to bright solid things. But an intensity that many solid points have, such as 0 from a sensor that
    rounds, says nothing of particles.
    """
    frame = view.frame
    some = _some(frame.place, view.classes)
    shape = _shapes(frame.place, frame.away_m, frame.range_m, frame.stride, some)
    intensity = view.scan.intensity[some]
    solid = (shape == SURFACE) & np.isfinite(intensity)
    intensity, some = intensity[solid], some[solid]
    band = np.searchsorted(RANGE_EDGES_M, frame.away_m[some], side="right")
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


def ask(moment: Moment, offsets: tuple[int, ...], kind: int, asked: I8, found: U1) -> None:
    """What scans at `offsets` tell of the points `asked`: in how many of four they are met again, and seen through."""
    known = moment.known(*offsets)
    if not known or not len(asked):
        found[:, kind] = NOT_ASKED
        return
    scan, votes = moment.view.scan, np.zeros((len(asked), 2), np.uint8)
    x, y, z = taken(scan.x_m, scan.y_m, scan.z_m, asked)
    for view, T_scan_neighbour in known:
        T, frame = inverse(T_scan_neighbour).astype(np.float32), view.frame
        place, away_m = places_from(x, y, z, T, frame.row_start, frame.columns)
        _vote(place, away_m, frame.range_m, frame.stride, votes)
    share = np.rint(4.0 * votes / len(known)).astype(np.uint8)
    found[:, kind] = 5 * share[:, 0] + share[:, 1]


def shifts(flake: F8, cloud: F8, points: int) -> tuple[float, float]:
    """What the shares of flakes and of clouds in this very scan add to their log-odds; the shares are found with it.

    Expectation and maximisation of a mixture's weights, solid things being the third. In clear air not all of it counts,
    since particles keep to places.
    """
    usual = np.log(weights.SHARES / (1.0 - weights.SHARES))
    risen, shift = np.exp(np.clip(np.stack((flake, cloud)), -MOST_ODDS, MOST_ODDS)), np.zeros(2)
    for _ in range(STEPS):
        weighed = risen * np.exp(shift)[:, None]
        share = np.clip((weighed / (1.0 + weighed.sum(axis=0))).sum(axis=1) / points, LEAST_SHARE, 0.5)
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
def drawn_points(place: I4) -> int:
    count = 0
    for n in range(len(place)):
        count += place[n] >= 0
    return count


@kernel
def _some(place: I4, classes: U1) -> I8:
    """Every so-manieth point that is drawn and STATIC."""
    step = max(SAMPLED, len(place) // SAMPLES)
    out, seen, kept = np.empty(len(place) // step + 1, np.int64), 0, 0
    for n in range(len(place)):
        if place[n] >= 0 and classes[n] == STATIC:
            if seen % step == 0:
                out[kept] = n
                kept += 1
            seen += 1
    return out[:kept].copy()


@kernel
def _sift(place: I4, away: F4, ranges: F4, classes: U1, intensity: F4, edges: F8) -> tuple[I8, U1]:
    """The points (m,) that are neither as bright as no particle is, nor flat ground; their bins of strength, range, ground."""
    out, dim, kept = np.empty(len(place) + 1, np.int64), 0, 0
    told = len(edges) > 0
    bright = edges[:, BRIGHTER - 1].copy() if told else np.full(len(RANGE_EDGES_M) + 1, np.inf)
    for n in range(len(place)):  # written without a branch, which could not be foretold
        out[dim] = n
        dim += int((place[n] >= 0) & (not intensity[n] >= bright[WHOLE(_band(away[n]))]))
    for m in range(dim):
        n = out[m]
        k, r = WHOLE(place[n]), away[n]
        flat = _bend(ranges[k + WHOLE(1)], ranges[k - WHOLE(1)], r) < NOISE_M + NOISE_PER_M * r
        out[kept] = n
        kept += int((classes[n] != GROUND) | (not flat))
    found = np.zeros((kept, KINDS), np.uint8)
    for m in range(kept):
        n = out[m]
        band = _band(away[n])
        found[m, RANGE], found[m, ON_GROUND] = band, classes[n] == GROUND
        found[m, STRENGTH] = _bin_of(intensity[n], edges[band]) if told else UNKNOWN
    return out[:kept].copy(), found


@kernel
def _band(r: float) -> int:
    return int(r >= BANDS_M[0]) + int(r >= BANDS_M[1]) + int(r >= BANDS_M[2]) + int(r >= BANDS_M[3])


@kernel
def _shapes(place: I4, away: F4, ranges: F4, stride: int, asked: I8) -> U1:
    """Bin (m,) of shape of the points `asked`: on how many lines between opposite neighbours they lie, how many are near."""
    out, step = np.empty(len(asked), np.uint8), WHOLE(stride)
    for m in range(len(asked)):
        k, r = WHOLE(place[asked[m]]), away[asked[m]]
        noise, tolerance = NOISE_M + NOISE_PER_M * r, max(NEAR_M, NEAR_PER_M * r)
        bend: Float = UNBENT
        straight, count = 0, -1
        first = k - step - WHOLE(2)
        for i in range(WHOLE(3)):
            for j in range(WHOLE(5)):
                a = ranges[first + i * step + j]
                count += (a > ZERO) & (abs(a - r) < tolerance)
        for d in (WHOLE(1), WHOLE(2), step - WHOLE(1), step, step + WHOLE(1)):
            off = _bend(ranges[k + d], ranges[k - d], r)
            bend, straight = min(bend, off), straight + (off < noise)
        lines = 1 + min(straight, MOST_LINES) if bend < FAR_OFF * noise else 0
        out[m] = lines * (len(COUNT_EDGES) + 1) + _bin_of(float(count), COUNT_EDGES)
    return out


@kernel
def _bend(a: float, b: float, r: float) -> float:
    """How far range `r` is off the line between its neighbours `a` and `b`: planes are straight in 1 / range."""
    both = a * b
    off = abs(TWICE * both / (a + b) - r)  # before it is asked whether there are two: so it is no branch
    return off if both > ZERO else UNBENT  # type: ignore[return-value]


@kernel
def _vote(place: I4, away: F4, ranges: F4, stride: int, votes: U1) -> None:
    """Adds one to votes (m, 2) of the points met again, and of those looked through, in one neighbouring scan."""
    step = WHOLE(stride)
    for m in range(len(place)):
        k, r = WHOLE(place[m]), away[m]
        same, beyond = SAME_M + SAME_PER_M * r, r + (BEYOND_M + BEYOND_PER_M * r)
        met, behind = 0, 0
        first = k - step - WHOLE(1)
        for i in range(WHOLE(3)):
            for j in range(WHOLE(3)):
                a = ranges[first + i * step + j]
                met += abs(a - r) < same
                behind += (a == ZERO) | (a > beyond)
        votes[m, 0] += met > 0
        votes[m, 1] += behind >= LOOKED_THROUGH


@kernel
def log_odds(found: U1, table: F8) -> F4:
    """Sum (m,) of what each kind of evidence says; the table (KINDS + 1, MOST_BINS) ends with a constant."""
    out = np.empty(len(found), np.float32)
    for m in range(len(found)):
        total = table[KINDS, 0]
        for k in range(KINDS):
            total += table[k, found[m, k]]
        out[m] = total
    return out


@kernel
def context(
    place: I4, point: I4, ranges: F4, stride: int, away: F4, x: F4, y: F4, z: F4, asked: I8, odds: F4
) -> U1:  # fmt: skip
    """Bin (m,) of what the points around each of those `asked` say: their mean log-odds, and how many they are."""
    out, step = np.zeros(len(asked), np.uint8), WHOLE(stride)
    for m in range(len(asked)):
        n = asked[m]
        near = AMONG_M + AMONG_PER_M * away[n]
        total, count = 0.0, 0
        first = WHOLE(place[n]) - step - WHOLE(4)
        for i in range(WHOLE(3)):
            for k in range(WHOLE(9)):
                at = first + i * step + k
                if not abs(ranges[at] - away[n]) < near:  # no nearer than that: need not be looked up
                    continue
                j = point[at]
                if j < 0 or j == n:
                    continue
                dx, dy, dz = x[j] - x[n], y[j] - y[n], z[j] - z[n]
                if dx * dx + dy * dy + dz * dz < near * near:
                    total += min(max(odds[j], -LIMIT), LIMIT)
                    count += 1
        if count > 0:
            said = _bin_of(total / count, CONTEXT_EDGES)
            out[m] = 1 + said * (len(AMONG_EDGES) + 1) + _bin_of(float(count), AMONG_EDGES)
    return out
