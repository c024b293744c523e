"""Where rays leave a flat piece: the last ray on it and the first beyond; the true edge lies between the two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.sweep import B1, Sweep
from scanloom.stages.geometry.se3 import F8

_FEW = 3
"""Points of a beam on a piece, at least, for its ends to count."""


@dataclass(frozen=True)
class Edges:
    """Pairs of rays with an edge between them."""

    on: F8
    """Unit vectors (e, 3) of the last ray on the piece."""
    off: F8
    """Of the first beyond it."""
    left: B1
    """The edge is to the left of the piece as the sensor sees it; of no meaning for `across`."""
    across: B1
    """Between two beams instead of along one."""
    weight: F8
    """Share of an observation: pairs between the same two beams are one together."""


def edges_of(sweep: Sweep, patch: Patch) -> Edges:
    """Edges along beams, left and right, and above and below between beams.

    No edge is where something nearer hides it, or where the sensor's view ends.
    """
    along = _along(sweep, patch)
    across = _across(sweep, patch)
    return Edges(*(np.concatenate(pair) for pair in zip(along, across)))


def _along(sweep: Sweep, patch: Patch) -> tuple[F8, F8, B1, B1, F8]:
    on, off, left = [], [], []
    for beam in np.unique(sweep.beam[patch.rays]):
        rays = patch.rays[sweep.beam[patch.rays] == beam]
        if len(rays) < _FEW:
            continue
        for ray, side in ((rays[0], -1), (rays[-1], 1)):
            beyond = _beyond(sweep, patch, int(ray), side)
            if beyond is not None:
                on.append(sweep.direction[ray])
                off.append(beyond)
                left.append(side > 0)
    n = len(on)
    return (
        np.reshape(on, (n, 3)),
        np.reshape(off, (n, 3)),
        np.array(left, np.bool_),
        np.zeros(n, np.bool_),
        np.ones(n),
    )


def _beyond(sweep: Sweep, patch: Patch, ray: int, side: int) -> F8 | None:
    """Direction of the ray next to the last one of a beam; where it did not return, as it would have gone."""
    beam = int(sweep.beam[ray])
    step = sweep.step_rad[beam]
    neighbour = ray + side
    there = sweep.first_beam[beam] <= neighbour < sweep.first_beam[beam + 1]
    if there and abs(sweep.azimuth[neighbour] - sweep.azimuth[ray]) < 1.7 * step:
        if _hides(sweep, patch, neighbour):
            return None
        there_it_went: F8 = sweep.direction[neighbour]
        return there_it_went
    if _at_the_end_of_view(sweep, float(sweep.azimuth[ray]), float(step)):
        return None
    return _turned(sweep.direction[ray], side * step)


def _hides(sweep: Sweep, patch: Patch, ray: int) -> bool:
    """Something stands clearly before the piece's plane there."""
    slope = float(patch.normal @ sweep.direction[ray])
    reach = -patch.distance_m / slope if slope < -1e-3 else np.inf
    return bool(sweep.range_m[ray] < reach - max(2 * patch.tolerance_m, 0.08))


def _at_the_end_of_view(sweep: Sweep, azimuth: float, step: float) -> bool:
    if sweep.blind is None:
        return False
    turn = 2 * np.pi
    return any(abs((azimuth - end + np.pi) % turn - np.pi) < 1.5 * step for end in sweep.blind)


def _turned(direction: F8, angle: float) -> F8:
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = direction
    return np.array([c * x - s * y, s * x + c * y, z])


def _across(sweep: Sweep, patch: Patch) -> tuple[F8, F8, B1, B1, F8]:
    """Pairs of a ray on the uppermost beam and one of the beam above at the same azimuth, and the same below."""
    beams = sweep.beam[patch.rays]
    on, off, weight = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for beam, other in ((beams.max(), beams.max() + 1), (beams.min(), beams.min() - 1)):
        if not 0 <= other < len(sweep.first_beam) - 1:
            continue
        rays = patch.rays[beams == beam]
        start, end = sweep.first_beam[other], sweep.first_beam[other + 1]
        elevation = np.median(np.arcsin(sweep.direction[start:end, 2])) if end > start else np.nan
        if not np.isfinite(elevation):
            continue
        near = (
            np.clip(np.searchsorted(sweep.azimuth[start:end], sweep.azimuth[rays]), 0, end - start - 1)
            + start
        )
        there = np.abs(sweep.azimuth[near] - sweep.azimuth[rays]) < 3 * sweep.step_rad[other]
        hidden = np.array([_hides(sweep, patch, int(ray)) for ray in near]) & there
        rays = rays[~hidden]
        if not len(rays):
            continue
        level = np.cos(elevation)
        azimuth = sweep.azimuth[rays]
        on.append(sweep.direction[rays])
        off.append(
            np.column_stack(
                (level * np.cos(azimuth), level * np.sin(azimuth), np.full(len(rays), np.sin(elevation)))
            )
        )
        weight.append(np.full(len(rays), 1.0 / len(rays)))
    w = np.concatenate(weight)
    n = len(w)
    return np.concatenate(on), np.concatenate(off), np.zeros(n, np.bool_), np.ones(n, np.bool_), w
