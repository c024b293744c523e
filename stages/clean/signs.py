"""Signs of a particle: bins of what is known of a return, each of which adds its log-odds.

What surrounds a return in its scan, the thing it hangs together with, the moving box around it and the weather of the scan
are read off what the returns are taken for, round by round; strength, contrast, range, how it lies to the lines between its
neighbours, and the map's word on its place stay.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import Standing
from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.around import (
    AIR,
    ASIDE,
    BEYOND,
    GROUND,
    NOTHING,
    OFF_LINE,
    SOLID,
    UPWARDS,
    WENT,
    look_around,
    off_line,
)
from scanloom.stages.clean.incidence import COLUMN_BITS, LAST_COLUMN
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]
U1 = NDArray[np.uint8]

GROUND_CLASS, DYNAMIC = int(PointClass.GROUND), int(PointClass.DYNAMIC)
AIRBORNE, OUTLIER = int(PointClass.AIRBORNE), int(PointClass.OUTLIER)
MOVED = int(Standing.MOVED)

WHAT, THING, SOLID_AROUND, AIR_AROUND, FAR, BOX, THING_WENT, WEATHER, STRENGTH, BEHIND = range(10)
NEAR_STANDS, NEAR_WENT, WENT_AROUND, HEIGHT, CLOUD, CLASS_IN_WEATHER, CLASS_STRENGTH, CONTRAST, ROUGH = range(
    10, 19
)
KINDS = 19

SHARE_EDGES = np.array([1e-6, 0.1, 0.3, 0.5, 0.8, 1.0 - 1e-6])
SIZE_EDGES = np.array([2.0, 5.0, 20.0, 100.0])
AROUND_EDGES = np.array([1e-6, 0.25, 0.5, 0.75])
COUNT_EDGES = np.array([1.0, 4.0, 10.0])
RANGE_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
BOX_EDGES = np.array([0.05, 0.2, 0.4, 0.6, 0.8])
WENT_EDGES = np.array([0.1, 0.4, 0.7])
SCAN_EDGES = np.array([5e-4, 2e-3, 5e-3, 0.01, 0.03, 0.1])
CLOUDY_EDGES = np.array([0.1, 0.3, 0.6])
BEYOND_EDGES = np.array([1.0, 5.0, 10.0, 20.0])
NEAR_EDGES = np.array([1.0, 2.0, 4.0, 8.0])
HEIGHT_EDGES_M = np.array([-0.1, 0.04, 0.1, 0.2, 0.4, 0.8])
CLASSES, SIZES, RANGES, CLOUDY = 5, len(SIZE_EDGES) + 1, len(RANGE_EDGES_M) + 1, len(CLOUDY_EDGES) + 1
IN_NO_BOX, BESIDE_A_BOX = len(BOX_EDGES) + 1, len(BOX_EDGES) + 2
NO_GROUND = len(HEIGHT_EDGES_M) + 1
NO_BOX = np.int32(-1)
MANY = 5
"""Returns of a thing from which on it tells whether it went, and whether what is in the air hangs in clouds."""
HALF = 3
"""Bin of a share from which on it is at least a half."""


@kernel
def signs(
    x: F4, y: F4, z: F4, away: F4, classes: U1, said: U1, box: I4, beside: B1, near: U1, cell: I4, image: I4,
    ranges: F4, thing: I4, strength: U1, contrast: U1, taken: U1, loose: B1, asked: I8,
) -> U1:  # fmt: skip
    """Bins (m, KINDS) of the returns asked about, all (n,) being what they are taken for.

    away (n,): ranges, m; `ranges` those in the image (`seen_ranges`). near (n, 2): voxels around that stand, that went.
    loose (n,): what things are counted of. strength, contrast (n,): bins.
    """
    members = np.flatnonzero(loose)
    size, air, went = _of_things(said, taken, thing, members)
    inside, air_inside = _of_boxes(taken, box)
    share, cloudy = _of_scan(taken, thing, size, members)
    found = np.empty((len(asked), KINDS), np.uint8)
    around, ground_m = np.zeros(NOTHING + 1, np.int64), np.zeros(1)
    for m in range(len(asked)):
        n = asked[m]
        t, what = thing[n], _what(classes[n])
        far = _bin_of(np.sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]), RANGE_EDGES_M)
        in_box = BESIDE_A_BOX if beside[n] else IN_NO_BOX
        if box[n] >= 0:
            in_box = _bin_of(air_inside[box[n]] / max(inside[box[n]], 1), BOX_EDGES)
        found[m, WHAT] = 3 * what + min(said[n], 2)
        found[m, BOX] = 2 * in_box + (what == 2)
        found[m, WEATHER] = CLOUDY * share + cloudy
        found[m, CLASS_IN_WEATHER] = CLASSES * (2 * share + (cloudy > 1)) + what
        found[m, STRENGTH] = RANGES * strength[n] + far
        found[m, CLASS_STRENGTH] = CLASSES * strength[n] + what
        found[m, CONTRAST] = CLASSES * contrast[n] + what
        found[m, ROUGH] = 2 * _rough(ranges, cell[n], away[n]) + (what == 2)
        found[m, NEAR_STANDS] = CLASSES * _bin_of(float(near[n, 0]), NEAR_EDGES) + what
        found[m, NEAR_WENT] = CLOUDY * _bin_of(float(near[n, 1]), NEAR_EDGES) + cloudy
        _write_thing(size[t], air[t], went[t], far, cloudy, found[m])
        look_around(x, y, z, away, n, cell[n], image, ranges, taken, around, ground_m)
        _write_around(around, z[n] - ground_m[0] / max(around[GROUND], 1), far, what, beside[n], found[m])
    return found


@kernel
def _rough(ranges: F4, cell: int, r: float) -> int:
    """How a return lies to the lines between those left and right of it, and above and below."""
    if cell < 0:
        return 0
    row, column = cell >> COLUMN_BITS, cell & LAST_COLUMN
    beside = off_line(ranges, row, column, r, 0, 1, ASIDE)
    return OFF_LINE * beside + off_line(ranges, row, column, r, 1, 0, UPWARDS)


@kernel
def _write_thing(size: int, air: int, went: int, far: int, cloudy: int, found: U1) -> None:
    """Bins (KINDS,) of the thing that a return is part of."""
    sized, flying = _bin_of(float(size), SIZE_EDGES), _bin_of(air / max(size, 1), SHARE_EDGES)
    found[THING] = SIZES * flying + sized
    found[FAR] = 3 * far + (flying > 0) + (flying > HALF)
    found[CLOUD] = 2 * (CLOUDY * sized + cloudy) + (flying > HALF)
    found[THING_WENT] = 2 * _bin_of(went / max(size, 1), WENT_EDGES) + (size >= MANY)


@kernel
def _write_around(around: I8, height_m: float, far: int, what: int, beside: bool, found: U1) -> None:
    """Bins (KINDS,) of what surrounds a return, given its height over the ground around."""
    near = around[:NOTHING].sum()
    count = max(near, 1)
    air = _bin_of(around[AIR] / count, AROUND_EDGES)
    solid = _bin_of((around[SOLID] + around[GROUND]) / count, AROUND_EDGES)
    went = _bin_of(around[WENT] / count, AROUND_EDGES)
    high = NO_GROUND if around[GROUND] == 0 else _bin_of(height_m, HEIGHT_EDGES_M)
    found[SOLID_AROUND] = (len(COUNT_EDGES) + 1) * solid + _bin_of(float(near), COUNT_EDGES)
    found[AIR_AROUND] = CLASSES * air + what
    found[WENT_AROUND] = 2 * (2 * went + (air > 1)) + beside
    found[BEHIND] = RANGES * _bin_of(float(around[BEYOND]), BEYOND_EDGES) + far
    found[HEIGHT] = 2 * high + (what == CLASSES - 1)


@kernel
def _bin_of(value: float, edges: F8) -> int:
    k = 0
    while k < len(edges) and value >= edges[k]:
        k += 1
    return k


@kernel
def _what(class_: int) -> int:
    """0 solid, 1 dynamic, 2 airborne, 3 outlier, 4 ground."""
    if class_ == DYNAMIC:
        return 1
    if class_ == GROUND_CLASS:
        return CLASSES - 1
    return 2 if class_ == AIRBORNE else 3 if class_ == OUTLIER else 0


@kernel
def _of_things(said: U1, taken: U1, thing: I4, members: I8) -> tuple[I4, I4, I4]:
    """Members (n,) of each thing, by the number of its first; those in the air; those whose place went."""
    size, air, went = (
        np.zeros(len(thing), np.int32),
        np.zeros(len(thing), np.int32),
        np.zeros(len(thing), np.int32),
    )
    for n in members:
        size[thing[n]] += 1
        air[thing[n]] += taken[n] == AIR
        went[thing[n]] += said[n] >= MOVED
    return size, air, went


@kernel
def _of_boxes(taken: U1, box: I4) -> tuple[I4, I4]:
    """Returns of each moving box that are not ground; those in the air."""
    last = NO_BOX
    for n in range(len(box)):
        last = max(last, box[n])
    inside, air = np.zeros(last + 1, np.int32), np.zeros(last + 1, np.int32)
    if last > NO_BOX:
        for n in range(len(box)):
            if box[n] >= 0 and taken[n] != NOTHING and taken[n] != GROUND:
                inside[box[n]] += 1
                air[box[n]] += taken[n] == AIR
    return inside, air


@kernel
def _of_scan(taken: U1, thing: I4, size: I4, members: I8) -> tuple[int, int]:
    """Bins of the share of a scan that is in the air, and of the share of this that hangs together in clouds."""
    all_, air, hanging = 0, 0, 0
    for n in range(len(taken)):
        all_ += taken[n] != NOTHING
        air += taken[n] == AIR
    for n in members:
        hanging += taken[n] == AIR and size[thing[n]] >= MANY
    return _bin_of(air / max(all_, 1), SCAN_EDGES), _bin_of(hanging / max(air, 1), CLOUDY_EDGES)
