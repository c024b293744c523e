"""Exposure: how much brighter each image is than the others, what each lens keeps from its corners, how much brighter
the air makes what is far, and each camera's tint.

    log light seen = log light of the point + gain of the image + fall-off of the lens at that distance from the middle
                     + haze * distance

over all views of all points, by least squares that are reweighted for what disagrees (Cauchy). The points are eliminated
(Schur complement), so there are as many unknowns as images and rings. Vignetting and exposure from overlapping views: Goldman and Chen (2005).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.colour.views import F4, I4, I8, MOST_VIEWS, Views
from scanloom.stages.geometry.kernels import kernel

F8 = NDArray[np.float64]

RINGS = 8
"""Rings of equal area around the middle of a picture; within the first a lens keeps nothing."""
ROUNDS = 4
SCATTER = 0.15
"""Of logarithms of light about their mean; views that are farther off count less (Cauchy)."""
MOST_PAIRS = 20_000_000
"""Pairs of views of the same point that are asked, of evenly picked points."""
PRIOR = 10.0
"""Views that it takes to outweigh the belief that what an image shows is as bright as what others do."""
HAZE = 1e5
"""The same for the belief that air is clear, times metres squared."""
SMOOTH = 100.0
"""The same for the belief that the fall-off is a straight line over the rings."""


def equalised(views: Views, images: int, cameras: int) -> F4:
    """Logarithms of light (n, 3) of the views as if all images had one exposure, all lenses no fall-off, all cameras the
    same tint and the air were clear."""
    light = views.light.astype(np.float64)
    rings = np.where(views.ring > 0, images + views.camera * (RINGS - 1) + views.ring - 1, -1).astype(
        np.int32
    )
    more = solved(views, light.mean(axis=1), views.image, rings, images, cameras)
    light -= (more[views.image] + np.where(rings >= 0, more[rings], 0.0) + more[-1] * views.away)[:, None]
    if cameras > 1:
        none = np.full(len(views), -1, np.int32)
        tint = np.zeros((cameras, 3))
        for channel in (0, 2):
            ratio = light[:, channel] - light[:, 1]
            tint[:, channel] = solved(views, ratio, views.camera, none, cameras, 0)[:-1]
        tint -= tint.mean(axis=0)
        light -= (tint - tint.mean(axis=1, keepdims=True))[views.camera]
    return light.astype(np.float32)


def solved(views: Views, value: F8, group: I4, ring: I4, groups: int, cameras: int) -> F8:
    """Offsets of groups, of rings and per metre of distance (groups + cameras * (RINGS - 1) + 1,) that make values (n,) of the
    same point agree."""
    starts, unknowns = views.starts, groups + cameras * (RINGS - 1) + 1
    step = max(int((np.minimum(np.diff(starts), MOST_VIEWS) ** 2).sum() / MOST_PAIRS), 1)
    away = views.away.astype(np.float64)
    overall = float(np.median(value))
    prior = np.array(
        [np.median(value[group == g]) - overall if (group == g).any() else 0.0 for g in range(groups)]
    )
    more: F8 = np.zeros(unknowns)
    for _ in range(ROUNDS):
        N, rhs = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        _gather(starts, step, value, views.weight, group, ring, away, more, SCATTER, N, rhs)
        N[np.arange(groups), np.arange(groups)] += PRIOR
        rhs[:groups] += PRIOR * prior
        N[-1, -1] += HAZE
        for camera in range(cameras):
            _smooth(N, groups + camera * (RINGS - 1))
        more = np.asarray(np.linalg.solve(N, rhs), np.float64)
    return more


def _smooth(N: F8, first: int) -> None:
    """Second differences of the rings of a camera, the first ring's being 0."""
    bend = np.zeros((RINGS - 2, RINGS))
    for k in range(RINGS - 2):
        bend[k, k : k + 3] = 1.0, -2.0, 1.0
    bend = bend[:, 1:]
    last = first + RINGS - 1
    N[first:last, first:last] += SMOOTH * (bend.T @ bend) + 1e-3 * np.eye(RINGS - 1)


@kernel
def _gather(
    starts: I8,
    step: int,
    value: F8,
    weight: F4,
    group: I4,
    ring: I4,
    away: F8,
    more: F8,
    scatter: float,
    N: F8,
    rhs: F8,
) -> None:
    """Normal equations of every `step`-th point, its own value eliminated."""
    place = np.empty(2 * MOST_VIEWS + 1, np.int64)
    share = np.empty(2 * MOST_VIEWS + 1)
    haze = len(more) - 1
    for p in range(0, len(starts) - 1, step):
        first, last = starts[p], min(starts[p + 1], starts[p] + MOST_VIEWS)
        if last - first < 2:
            continue
        left = np.empty(last - first)
        for k in range(first, last):
            left[k - first] = value[k] - more[group[k]] - more[haze] * away[k]
            if ring[k] >= 0:
                left[k - first] -= more[ring[k]]
        middle = np.median(left)
        total, mean, far, count = 0.0, 0.0, 0.0, 0
        for k in range(first, last):
            w = weight[k] / (1.0 + ((left[k - first] - middle) / scatter) ** 2)
            total += w
            mean += w * value[k]
            far += w * away[k]
            left[k - first] = w
        mean /= total
        for k in range(first, last):
            w, g, r = left[k - first], group[k], ring[k]
            N[g, g] += w
            N[g, haze] += w * away[k]
            N[haze, g] += w * away[k]
            N[haze, haze] += w * away[k] * away[k]
            rhs[g] += w * (value[k] - mean)
            rhs[haze] += w * (value[k] - mean) * away[k]
            place[count], share[count] = g, w
            count += 1
            if r >= 0:
                N[r, r] += w
                N[g, r] += w
                N[r, g] += w
                N[r, haze] += w * away[k]
                N[haze, r] += w * away[k]
                rhs[r] += w * (value[k] - mean)
                place[count], share[count] = r, w
                count += 1
        place[count], share[count] = haze, far
        count += 1
        for i in range(count):
            for j in range(count):
                N[place[i], place[j]] -= share[i] * share[j] / total
