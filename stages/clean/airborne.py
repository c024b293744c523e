"""What is in the air, by all that is known in the end: what denoise took it for, and what the map says of its place.

Denoise sees a few scans. Here it is known whether a place stands or was seen through before and after, which returns hang
together, and whose box they lie in. Each kind of evidence adds the log-odds that it gives of a particle against anything
else; then all is heard once more, the returns around and the rest of a thing being what the first round took them for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import Standing
from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.stages.clean import weights
from scanloom.stages.clean.clusters import clusters
from scanloom.stages.clean.incidence import COLUMNS, I4, ROWS
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I8 = NDArray[np.int64]
U1 = NDArray[np.uint8]

DYNAMIC, AIRBORNE, OUTLIER = int(PointClass.DYNAMIC), int(PointClass.AIRBORNE), int(PointClass.OUTLIER)
MOVED = int(Standing.MOVED)

WHAT, THING, SOLID_AROUND, AIR_AROUND, FAR, BOX, THING_WENT, SCAN, STRENGTH, BEHIND = range(10)
KINDS = 10

OTHER, SOLID, GROUND, AIR, WENT, NOTHING = range(6)
"""What a return is taken for while others ask about it. NOTHING: the own vehicle, and what is out of range."""
BEYOND = NOTHING
"""In counts of what lies around: that which is farther off than near, and behind."""

SHARE_EDGES = np.array([1e-6, 0.1, 0.3, 0.5, 0.8, 1.0 - 1e-6])
SIZE_EDGES = np.array([2.0, 5.0, 20.0, 100.0])
AROUND_EDGES = np.array([1e-6, 0.25, 0.5, 0.75])
COUNT_EDGES = np.array([1.0, 4.0, 10.0])
RANGE_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
BOX_EDGES = np.array([0.05, 0.2, 0.4, 0.6, 0.8])
WENT_EDGES = np.array([0.1, 0.4, 0.7])
SCAN_EDGES = np.array([5e-4, 2e-3, 5e-3, 0.01, 0.03, 0.1])
STRENGTH_EDGES = np.array([0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.13, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
BEYOND_EDGES = np.array([1.0, 5.0, 10.0, 20.0])
IN_NO_BOX, BESIDE_A_BOX = len(BOX_EDGES) + 1, len(BOX_EDGES) + 2
NO_STRENGTH = len(STRENGTH_EDGES) + 1
MANY = 5
"""Returns of a thing from which on it tells whether it went."""

BRIGHT, SAMPLED, LEAST_BRIGHT = 0.8, 8, 50
"""Quantile of the intensities of what stands that strengths are relative to; every so-manieth of them is looked at; fewer tell
nothing."""
ROUNDED = 0.01
"""When more than this share of what stands has the very lowest intensity, that tells nothing."""
LEAST_ODDS = (0.0, -0.5)
"""Log-odds of each round from which on a return is in the air. In the end a missed particle costs more than a lost leaf."""
BESIDE, ABOVE = 4, 3
"""Cells of the image to each side, and upwards and downwards, that lie around."""


def _by_class(solid: int, dynamic: int, air: int, ground: int, nothing: int) -> list[int]:
    """One value for each PointClass."""
    of = dict.fromkeys(PointClass, solid)
    of[PointClass.DYNAMIC], of[PointClass.AIRBORNE], of[PointClass.OUTLIER] = dynamic, air, air
    of[PointClass.GROUND], of[PointClass.EGO], of[PointClass.OUT_OF_RANGE] = ground, nothing, nothing
    return [of[each] for each in PointClass]


_WENT = _by_class(WENT, WENT, AIR, GROUND, NOTHING)
TAKEN = np.array(
    [
        _by_class(OTHER, WENT, AIR, GROUND, NOTHING),
        _by_class(SOLID, SOLID, SOLID, GROUND, NOTHING),
        _WENT,
        _WENT,
    ],
    np.uint8,
)
"""What a return is taken for at first, by Standing and PointClass."""
_ALL = _by_class(1, 1, 1, 0, 0)
ASKED = np.array([_ALL, _by_class(0, 1, 1, 0, 0), _ALL, _ALL], bool)
"""Whether it may be in the air: neither ground nor what denoise and the map agree on to stand."""
AFTERWARDS = np.array([OTHER, SOLID, WENT, WENT], np.uint8)
"""What is not in the air is taken for, by Standing."""


@dataclass(frozen=True)
class Known:
    """What is known of the returns (n,) of a scan."""

    classes: U1
    """By denoise."""
    said: U1
    """Standing of their places."""
    box: I4
    """Number of the moving box that they lie in, -1 for none."""
    beside: B1
    """Whether they lie in one or close to it."""
    cell: I4
    """In the image of directions, -1 outside."""
    image: I4


def may_fly(classes: U1, said: U1) -> B1:
    """Which returns (n,) are asked about, by class and Standing (n,)."""
    return np.asarray(ASKED[said, classes])


def airborne(scan: DeskewedScan, known: Known, apart_m: float) -> B1:
    """Which returns (n,) of a scan are in the air; neighbours whose ranges differ by less than `apart_m` are one thing."""
    out = np.zeros(len(scan), np.bool_)
    taken, asked = TAKEN[known.said, known.classes], np.flatnonzero(may_fly(known.classes, known.said))
    thing, strength = things(scan, known, apart_m), strengths(scan, known, asked)
    for table, least in zip(weights.ROUNDS, LEAST_ODDS, strict=True):
        fly = added(evidence(scan, known, thing, strength, taken, asked), table) > least
        out[asked] = fly
        taken[asked] = np.where(fly, AIR, AFTERWARDS[known.said[asked]])
    return out


def things(scan: DeskewedScan, known: Known, apart_m: float) -> I4:
    """Number (n,) of the first return of what each hangs together with, among those that may fly and do not stand."""
    loose = may_fly(known.classes, known.said) & (known.said != Standing.STANDS)
    return np.asarray(clusters(scan.x_m, scan.y_m, scan.z_m, loose, known.cell, apart_m))


def strengths(scan: DeskewedScan, known: Known, asked: I8) -> U1:
    """Bin (m,) of the intensity of each return asked about, relative to the brighter ones of what stands."""
    standing = scan.intensity[known.said == Standing.STANDS][::SAMPLED]
    standing = standing[np.isfinite(standing)]
    if len(standing) < LEAST_BRIGHT or np.ptp(standing) == 0.0:
        return np.full(len(asked), NO_STRENGTH, np.uint8)
    intensity, faintest = scan.intensity[asked], standing.min()
    bright = float(np.quantile(standing, BRIGHT))
    out = np.searchsorted(STRENGTH_EDGES * bright, intensity, side="right")
    if np.mean(standing == faintest) > ROUNDED:
        out[intensity <= faintest] = NO_STRENGTH
    return out.astype(np.uint8)


def evidence(scan: DeskewedScan, known: Known, thing: I4, strength: U1, taken: U1, asked: I8) -> U1:
    """Bins (m, KINDS) of what is known of the returns asked about, the others being what they are taken for (n,)."""
    found = np.empty((len(asked), KINDS), np.uint8)
    found[:, STRENGTH] = strength
    _of_place(known.classes, known.said, taken, known.box, known.beside, asked, found)
    _of_thing(scan.x_m, scan.y_m, scan.z_m, known.said, taken, thing, asked, found)
    _of_surroundings(scan.x_m, scan.y_m, scan.z_m, taken, known.cell, known.image, asked, found)
    return found


@kernel
def added(found: U1, table: F8) -> F4:
    """Sum (m,) of what the kinds of evidence say; the table (KINDS + 1, bins) ends with a constant."""
    out = np.empty(len(found), np.float32)
    for m in range(len(found)):
        total = table[KINDS, 0]
        for k in range(KINDS):
            total += table[k, found[m, k]]
        out[m] = total
    return out


@kernel
def _bin_of(value: float, edges: F8) -> int:
    k = 0
    while k < len(edges) and value >= edges[k]:
        k += 1
    return k


@kernel
def _of_place(classes: U1, said: U1, taken: U1, box: I4, beside: B1, asked: I8, found: U1) -> None:
    """Class and verdict; how much of the moving box around it is in the air, how much of the scan."""
    boxes = np.int64(0)
    for n in range(len(box)):
        boxes = max(boxes, box[n] + 1)
    inside, air_inside = np.zeros(boxes), np.zeros(boxes)
    all_, air = 0, 0
    for n in range(len(taken)):
        all_ += taken[n] != NOTHING
        air += taken[n] == AIR
        if box[n] >= 0 and taken[n] != NOTHING and taken[n] != GROUND:
            inside[box[n]] += 1.0
            air_inside[box[n]] += taken[n] == AIR
    of_scan = _bin_of(air / max(all_, 1), SCAN_EDGES)
    for m in range(len(asked)):
        n = asked[m]
        found[m, WHAT] = 3 * _what(classes[n]) + min(said[n], 2)
        found[m, SCAN] = of_scan
        found[m, BOX] = BESIDE_A_BOX if beside[n] else IN_NO_BOX
        if box[n] >= 0:
            found[m, BOX] = _bin_of(air_inside[box[n]] / inside[box[n]], BOX_EDGES)


@kernel
def _what(class_: int) -> int:
    """0 solid, 1 dynamic, 2 airborne, 3 outlier."""
    if class_ == DYNAMIC:
        return 1
    return 2 if class_ == AIRBORNE else 3 if class_ == OUTLIER else 0


@kernel
def _of_thing(x: F4, y: F4, z: F4, said: U1, taken: U1, thing: I4, asked: I8, found: U1) -> None:
    """How much of its thing is in the air and how large that is; how far off; how much of the thing went."""
    size, air, went = np.zeros(len(thing)), np.zeros(len(thing)), np.zeros(len(thing))
    for n in asked:
        size[thing[n]] += 1.0
        air[thing[n]] += taken[n] == AIR
        went[thing[n]] += said[n] >= MOVED
    for m in range(len(asked)):
        n = asked[m]
        t = thing[n]
        share = _bin_of(air[t] / size[t], SHARE_EDGES)
        far = _bin_of(np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]), RANGE_EDGES_M)
        found[m, THING] = share * (len(SIZE_EDGES) + 1) + _bin_of(size[t], SIZE_EDGES)
        found[m, FAR] = 3 * far + (share > 0) + (share > 3)
        found[m, THING_WENT] = 2 * _bin_of(went[t] / size[t], WENT_EDGES) + (size[t] >= MANY)
        found[m, BEHIND] = far


@kernel
def _of_surroundings(x: F4, y: F4, z: F4, taken: U1, cell: I4, image: I4, asked: I8, found: U1) -> None:
    """How much of what lies around is solid, how much in the air; how much is seen beyond it.

    AIR_AROUND is told for each class apart, BEHIND for each range, which stands there before.
    """
    around = np.zeros(NOTHING + 1, np.int64)
    for m in range(len(asked)):
        n = asked[m]
        around[:] = 0
        if cell[n] >= 0:
            _look_around(x, y, z, n, cell[n], image, taken, around)
        count = around[:NOTHING].sum()
        solid, air = around[SOLID] + around[GROUND], around[AIR]
        by_solid = _bin_of(solid / max(count, 1), AROUND_EDGES)
        found[m, SOLID_AROUND] = by_solid * (len(COUNT_EDGES) + 1) + _bin_of(float(count), COUNT_EDGES)
        found[m, AIR_AROUND] = 4 * _bin_of(air / max(count, 1), AROUND_EDGES) + found[m, WHAT] // 3
        found[m, BEHIND] += (len(RANGE_EDGES_M) + 1) * _bin_of(float(around[BEYOND]), BEYOND_EDGES)


@kernel
def _look_around(x: F4, y: F4, z: F4, n: int, cell: int, image: I4, taken: U1, around: I8) -> None:
    """Count what the returns near return n are taken for, and those beyond."""
    row, column = cell // COLUMNS, cell % COLUMNS
    square = x[n] * x[n] + y[n] * y[n] + z[n] * z[n]
    near = 0.6 + 0.03 * np.sqrt(square)
    for v in range(max(row - ABOVE, 0), min(row + ABOVE + 1, ROWS)):
        for du in range(-BESIDE, BESIDE + 1):
            j = image[v, (column + du) % COLUMNS]
            if j < 0 or j == n or taken[j] == NOTHING:
                continue
            dx, dy, dz = x[j] - x[n], y[j] - y[n], z[j] - z[n]
            if dx * dx + dy * dy + dz * dz < near * near:
                around[taken[j]] += 1
            elif x[j] * x[j] + y[j] * y[j] + z[j] * z[j] > square:
                around[BEYOND] += 1
