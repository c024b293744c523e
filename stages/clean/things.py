"""Classes by verdict: return by return, then with the thing that each is part of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.clean import Standing
from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.kernels import kernel

U1 = NDArray[np.uint8]
B1 = NDArray[np.bool_]
I4 = NDArray[np.int32]

UNLABELLED, GROUND, STATIC, DYNAMIC, AIRBORNE, OUTLIER, CHANGED = (
    np.uint8(each)
    for each in (
        PointClass.UNLABELLED,
        PointClass.GROUND,
        PointClass.STATIC,
        PointClass.DYNAMIC,
        PointClass.AIRBORNE,
        PointClass.OUTLIER,
        PointClass.CHANGED,
    )
)
STANDS, MOVED, HAS_CHANGED = (np.uint8(each) for each in (Standing.STANDS, Standing.MOVED, Standing.CHANGED))


@kernel
def settle(classes: U1, said: U1, fly: B1, box: I4, around: B1, above: B1) -> tuple[U1, B1]:
    """Classes (n,) of returns of which some fly, and which of them are judged by things.

    What denoise took for something else and the map knows to stand is restored; strays in a moving box are its own, and
    so is what is too high for ground. What a box says of returns is written into `said`.
    """
    out, judged = classes.copy(), np.empty(len(classes), np.bool_)
    for n in range(len(out)):
        stands, kind = said[n] == STANDS, out[n]
        if kind == AIRBORNE or (stands and kind in (DYNAMIC, OUTLIER)):
            kind = STATIC
        if box[n] >= 0 and kind == OUTLIER:
            kind = DYNAMIC
        if fly[n]:
            kind = AIRBORNE
        elif kind == GROUND and above[n]:
            kind = DYNAMIC
        judged[n] = kind in (UNLABELLED, STATIC, DYNAMIC)
        if kind == DYNAMIC or (judged[n] and (box[n] >= 0 or (around[n] and not stands))):
            said[n] = MOVED
        out[n] = kind
    return out, judged


@kernel
def judge_things(
    thing: I4, judged: B1, usable: B1, said: U1, least_points: int, least_share: float, out: U1
) -> None:
    """Write into the classes `out` (n,) what moved or has changed, and things of which this share did; moved comes last.

    thing (n,): number of its first return; those not usable are alone.
    """
    size, changed, moved = (
        np.zeros(len(out), np.int32),
        np.zeros(len(out), np.int32),
        np.zeros(len(out), np.int32),
    )
    for n in range(len(out)):
        if usable[n]:
            t = thing[n]
            size[t] += 1
            changed[t] += said[n] == HAS_CHANGED
            moved[t] += said[n] == MOVED
    for n in range(len(out)):
        if not judged[n]:
            continue
        t = thing[n]
        whole = usable[n] and size[t] >= least_points
        if said[n] == MOVED or (whole and moved[t] >= least_share * size[t]):
            out[n] = DYNAMIC
        elif said[n] == HAS_CHANGED or (whole and changed[t] >= least_share * size[t]):
            out[n] = CHANGED
