"""How strong returns are, relative to those of solid things at their range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.denoise.shapes import FLAT, SURFACE, shapes_of
from scanloom.stages.denoise.window import View
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

U1 = NDArray[np.uint8]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

STATIC = int(PointClass.STATIC)
STRENGTH_EDGES = np.array([0.01, 0.02, 0.035, 0.05, 0.07, 0.1, 0.13, 0.2, 0.27, 0.35, 0.45, 0.6, 0.8])
RANGE_EDGES_M = np.array([5.0, 10.0, 20.0, 40.0])
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


def strength_edges(view: View, of_cell: U1) -> F8 | None:
    """Intensities (bands, edges) between the bins of strength, by range; None when the sensor tells none, or nothing
    solid is near.

    They are relative to bright solid things. But an intensity that many solid points have, such as 0 from a sensor that
    rounds, says nothing of particles. of_cell : `cell_shapes`.
    """
    frame = view.frame
    some = _some(frame.place, view.classes)
    shape = shapes_of(frame.place, frame.away_m, frame.range_m, frame.stride, of_cell, some)
    intensity = view.scan.intensity[some]
    solid = (shape | FLAT == SURFACE | FLAT) & np.isfinite(intensity)
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
