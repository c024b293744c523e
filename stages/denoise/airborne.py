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
from scanloom.stages.denoise.asking import FAR, NEAR, answers
from scanloom.stages.denoise.shapes import FLAT, cell_shapes, shapes_of
from scanloom.stages.denoise.strengths import BRIGHTER, RANGE_EDGES_M, strength_edges
from scanloom.stages.denoise.window import Moment, View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

GROUND = int(PointClass.GROUND)

STRENGTH, SHAPE, RANGE, ON_GROUND, AGAIN_NEAR, AGAIN_FAR = range(6)
KINDS, MOST_BINS = 6, weights.BINS
UNKNOWN = MOST_BINS - 1
"""Bin of a strength that the sensor does not tell."""
CONTEXT_EDGES = np.array([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
AMONG_EDGES = np.array([3.0, 6.0, 10.0])

LIMIT = 6.0
"""A single look is trusted no more than this log-odds."""
MOST_SHIFT, CLEAR_AIR = 1.0, 0.4
AMONG_M, AMONG_PER_M = np.float32(0.6), np.float32(0.03)
"""Points this near are heard."""
WHOLE = np.uint64
"""Of cells that are looked up: a signed number is asked each time whether it counts from the end."""
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
        asked, found = _in_doubt(asked, found, first)
        found[:, kind] = answers(moment, offsets, asked)
        odds[asked] = first = log_odds(found, weights.FIRST)
    frame = view.frame
    around = context(
        frame.place, frame.point, frame.range_m, frame.stride, frame.away_m, view.scan.x_m, view.scan.y_m, view.scan.z_m,
        asked, odds,
    )  # fmt: skip
    flake = log_odds(found, weights.FLAKE) + weights.CONTEXT_FLAKE[around]
    cloud = log_odds(found, weights.CLOUD) + weights.CONTEXT_CLOUD[around]
    by_flakes, by_clouds = shifts(flake, cloud, drawn)
    out[asked] = np.exp(flake + by_flakes) + np.exp(cloud + by_clouds) > 1.0
    return out


def own_evidence(view: View) -> tuple[I8, U1]:
    """Points (m,) that may be in the air, and bins (m, KINDS) of what the scan itself tells of them.

    Nothing yet of AGAIN_NEAR and AGAIN_FAR. The other points are as bright as no particle is, or flat ground.
    """
    frame = view.frame
    of_cell = cell_shapes(frame)
    edges = strength_edges(view, of_cell)
    found: tuple[I8, U1] = _sift(
        frame.place, frame.away_m, frame.range_m, frame.stride, of_cell, view.classes, view.scan.intensity,
        np.zeros((0, 0)) if edges is None else edges,
    )  # fmt: skip
    return found


def shifts(flake: F8, cloud: F8, points: int) -> tuple[float, float]:
    """What the shares of flakes and of clouds in this very scan add to their log-odds; the shares are found with it.

    Expectation and maximisation of a mixture's weights, solid things being the third. In clear air not all of it counts,
    since particles keep to places.
    """
    usual, shift = np.log(weights.SHARES / (1.0 - weights.SHARES)), np.zeros(2)
    flakes, clouds = (np.exp(np.clip(odds, -MOST_ODDS, MOST_ODDS)) for odds in (flake, cloud))
    for _ in range(STEPS):
        share = np.clip(_shared(flakes, clouds, np.exp(shift)) / points, LEAST_SHARE, 0.5)
        shift = np.log(share / (1.0 - share)) - usual
    capped = np.where(shift > 0.0, np.minimum(shift, MOST_SHIFT), CLEAR_AIR * shift)
    return float(capped[0]), float(capped[1])


@kernel
def _shared(flake: F8, cloud: F8, weight: F8) -> F8:
    """How many of the points (m,), with odds `flake` and `cloud` against solid things, are flakes and clouds (2,)."""
    out = np.zeros(2)
    for m in range(len(flake)):
        a, b = weight[0] * flake[m], weight[1] * cloud[m]
        part = 1.0 / (1.0 + a + b)
        out[0] += a * part
        out[1] += b * part
    return out


@kernel
def _in_doubt(asked: I8, found: U1, odds: F4) -> tuple[I8, U1]:
    """Those of the points `asked` (m,) and of their bins (m, KINDS) that further evidence may make airborne."""
    left, count = np.empty(len(asked) + 1, np.int64), 0
    for m in range(len(asked)):
        left[count] = m
        count += odds[m] > LEAST_ODDS
    rows, bins = np.empty(count, np.int64), np.empty((count, KINDS), np.uint8)
    for k in range(count):
        m = left[k]
        rows[k] = asked[m]
        for kind in range(KINDS):
            bins[k, kind] = found[m, kind]
    return rows, bins


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
def _sift(
    place: I4, away: F4, ranges: F4, stride: int, of_cell: U1, classes: U1, intensity: F4, edges: F8
) -> tuple[I8, U1]:
    """The points (m,) that are neither as bright as no particle is, nor flat ground; their bins (m, KINDS) so far."""
    out, dim, kept = np.empty(len(place) + 1, np.int64), 0, 0
    told = len(edges) > 0
    bright = edges[:, BRIGHTER - 1].copy() if told else np.full(len(RANGE_EDGES_M) + 1, np.inf)
    for n in range(len(place)):  # written without a branch, which could not be foretold
        out[dim] = n
        dim += int((place[n] >= 0) & (not intensity[n] >= bright[WHOLE(_band(away[n]))]))
    shape = shapes_of(place, away, ranges, stride, of_cell, out[:dim])
    for m in range(dim):
        n = out[m]
        out[kept], shape[kept] = n, shape[m]
        kept += int((classes[n] != GROUND) | (shape[m] < FLAT))
    found = np.zeros((kept, KINDS), np.uint8)
    for m in range(kept):
        n = out[m]
        band = _band(away[n])
        found[m, RANGE], found[m, ON_GROUND], found[m, SHAPE] = (
            band,
            classes[n] == GROUND,
            shape[m] & (FLAT - 1),
        )
        found[m, STRENGTH] = _bin_of(intensity[n], edges[band]) if told else UNKNOWN
    return out[:kept].copy(), found


@kernel
def _band(r: float) -> int:
    return int(r >= BANDS_M[0]) + int(r >= BANDS_M[1]) + int(r >= BANDS_M[2]) + int(r >= BANDS_M[3])


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
