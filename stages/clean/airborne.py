"""What is in the air, by all that is known in the end: what denoise took it for, and what the map says of its place.

Denoise sees a few scans. Here it is known whether a place stands or was seen through before and after, which returns hang
together, and whose box they lie in. Each kind of evidence (`signs`) adds the log-odds that it gives of a particle against
anything else; then all is heard again, the returns around and the rest of a thing being what the round before took them for.
Of the ground, and of what denoise and the map agree on to stand, only that is asked which sticks out or is much fainter than
what is beside it; of the ground, also that which has something in the air around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import Standing
from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.stages.clean import weights
from scanloom.stages.clean.around import (
    AIR,
    GROUND,
    NOTHING,
    OTHER,
    SOLID,
    WENT,
    contrasts,
    over_ground,
    seen_ranges,
    stands_out,
)
from scanloom.stages.clean.clusters import clusters
from scanloom.stages.clean.incidence import I4
from scanloom.stages.clean.signs import KINDS, signs
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]
F4 = NDArray[np.float32]
I8 = NDArray[np.int64]
U1 = NDArray[np.uint8]

STRENGTH_EDGES = np.array([0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.13, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
NO_STRENGTH = len(STRENGTH_EDGES) + 1
BRIGHT, SAMPLED, LEAST_BRIGHT = 0.8, 8, 50
"""Quantile of the intensities of what stands that strengths are relative to; every so-manieth of them is looked at; fewer tell
nothing."""
ROUNDED = 0.01
"""When more than this share of what stands has the very lowest intensity, that tells nothing."""
LEAST_ODDS = (0.8, 0.0, -0.9)
"""Log-odds of each round from which on a return is in the air: at first only what is sure, so that no large thing beside the
sensor talks itself into being a cloud."""
STANDS = int(Standing.STANDS)
HEARD_AGAIN = -6.0
"""Log-odds from which on a return is asked about in the next round."""


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
ASKED = np.array([_ALL, _by_class(0, 1, 1, 0, 0), _ALL, _ALL], np.uint8)
"""Whether it may be in the air wherever it is: neither ground nor what denoise and the map agree on to stand."""
AFTERWARDS = np.array([OTHER, SOLID, WENT, WENT], np.uint8)
"""What is neither ground nor in the air is taken for, by Standing."""


class Light(NamedTuple):
    """Intensities of what stands in a scan."""

    bright: float
    """Of the brighter ones."""
    lost: float
    """At and below this an intensity tells nothing: it was rounded off."""


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
    away_m: F4
    """Their ranges."""
    image: I4
    taken: U1
    """What they are taken for at first."""
    asked: I8
    """Those (m,) that may be in the air (`may_fly`)."""
    near: U1
    """(n, 2): how many of the 26 voxels around stand, and went; of those asked about."""
    contrast: U1
    """Bins of their intensity over that of the returns beside them."""
    light: Light | None


def light_of(scan: DeskewedScan, said: U1) -> Light | None:
    """What the intensities of a scan are relative to; None when they tell nothing. said (n,): Standing."""
    standing = scan.intensity[_some_standing(said)]
    standing = standing[np.isfinite(standing)]
    if len(standing) < LEAST_BRIGHT or np.ptp(standing) == 0.0:
        return None
    faintest = float(standing.min())
    rounded = np.mean(standing == faintest) > ROUNDED
    return Light(float(np.quantile(standing, BRIGHT)), faintest if rounded else -np.inf)


def may_fly(
    scan: DeskewedScan, classes: U1, said: U1, taken: U1, cell: I4, away_m: F4, image: I4, light: Light | None
) -> tuple[I8, U1]:
    """Returns (m,) that are asked about, by class and Standing (n,) and by what is around them; their contrasts (n,)."""
    lost = np.inf if light is None else light.lost
    may = by_standing(said, classes, ASKED).view(np.bool_)
    may |= stands_out(away_m, scan.intensity, lost, classes, cell, image)
    may |= over_ground(scan.x_m, scan.y_m, scan.z_m, away_m, classes, taken, cell, image)
    asked = np.flatnonzero(may)
    return asked, contrasts(away_m, scan.intensity, lost, cell, image, asked)


def airborne(scan: DeskewedScan, known: Known, apart_m: float) -> B1:
    """Which returns (n,) of a scan are in the air; neighbours whose ranges differ by less than `apart_m` are one thing."""
    out = np.zeros(len(scan), np.bool_)
    loose = is_loose(known)
    thing, strength = things(known, loose, apart_m), strengths(scan, known)
    taken, asked = known.taken.copy(), known.asked
    ranges = seen_ranges(known.away_m, taken, known.image)
    for table, least in zip(weights.ROUNDS, LEAST_ODDS, strict=True):
        odds = added(evidence(scan, known, ranges, thing, loose, strength, taken, asked), table)
        out[asked] = odds > least
        taken[asked] = taken_next(known, asked, odds > least)
        asked = asked[odds > HEARD_AGAIN]
    return out


def taken_next(known: Known, asked: I8, fly: B1) -> U1:
    """What the returns asked about (m,) are taken for, of which some fly."""
    rest = np.where(known.classes[asked] == PointClass.GROUND, GROUND, AFTERWARDS[known.said[asked]])
    return np.where(fly, AIR, rest).astype(np.uint8)


def is_loose(known: Known) -> B1:
    """Returns (n,) that things are made of: those asked about that do not stand, without ground."""
    said, classes = known.said[known.asked], known.classes[known.asked]
    out = np.zeros(len(known.said), np.bool_)
    out[known.asked] = (said != Standing.STANDS) & (classes != PointClass.GROUND)
    return out


def things(known: Known, loose: B1, apart_m: float) -> I4:
    """Number (n,) of the first return of what each hangs together with, among the loose."""
    return np.asarray(clusters(known.away_m, loose, known.cell, apart_m))


def strengths(scan: DeskewedScan, known: Known) -> U1:
    """Bin (n,) of the intensity of each return asked about, relative to the brighter ones of what stands."""
    out = np.full(len(scan), NO_STRENGTH, np.uint8)
    if known.light is None:
        return out
    intensity = scan.intensity[known.asked]
    bins = np.searchsorted(STRENGTH_EDGES * known.light.bright, intensity, side="right")
    bins[intensity <= known.light.lost] = NO_STRENGTH
    out[known.asked] = bins
    return out


def evidence(
    scan: DeskewedScan, known: Known, ranges: F4, thing: I4, loose: B1, strength: U1, taken: U1, asked: I8
) -> U1:
    """Bins (m, KINDS) of what is known of the returns asked about, the others being what they are taken for (n,)."""
    return np.asarray(
        signs(
            scan.x_m, scan.y_m, scan.z_m, known.away_m, known.classes, known.said, known.box, known.beside, known.near,
            known.cell, known.image, ranges, thing, strength, known.contrast, taken, loose, asked,
        )
    )  # fmt: skip


@kernel
def by_standing(said: U1, classes: U1, table: U1) -> U1:
    """Value (n,) of a table (Standing, PointClass) for each return."""
    out = np.empty(len(said), np.uint8)
    for n in range(len(said)):
        out[n] = table[said[n], classes[n]]
    return out


@kernel
def _some_standing(said: U1) -> I8:
    """Every so-manieth return whose place stands."""
    out, seen, kept = np.empty(len(said) // SAMPLED + 1, np.int64), 0, 0
    for n in range(len(said)):
        if said[n] == STANDS:
            if seen % SAMPLED == 0:
                out[kept] = n
                kept += 1
            seen += 1
    return out[:kept].copy()


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
