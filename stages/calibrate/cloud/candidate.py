"""What is known of one candidate, ray by ray."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.cloud.edges import Edges
from scanloom.stages.calibrate.cloud.patches import Patch
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.calibrate.cloud.sweep import B1, I8, Sweep
from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class Seen:
    """What is known of one candidate, ray by ray."""

    board: Board
    direction: F8
    range_m: F8
    intensity: F8
    beam: I8
    """0, 1, ... without gaps."""
    beams: I8
    """What the sensor calls them."""
    inner: B1
    """Not at the end of a run: the range is the board's alone."""
    edges: Edges
    width_m: float
    """Of the beam at the board."""
    first_dark: bool
    squares: bool
    """The reflectance is used."""
    range_sigma_m: float
    beam_sigma_m: float


def seen_of(sweep: Sweep, patch: Patch, edges: Edges, board: Board, settings: CloudSettings) -> Seen:
    """A piece of a cloud as a candidate; its squares are not looked at yet."""
    rays = patch.rays
    beam = sweep.beam[rays]
    change = np.diff(beam) != 0
    inner = ~(np.concatenate(([True], change)) | np.concatenate((change, [True])))
    distance = float(np.median(sweep.range_m[rays]))
    return Seen(
        board=board,
        direction=sweep.direction[rays],
        range_m=sweep.range_m[rays],
        intensity=sweep.intensity[rays],
        beam=np.unique(beam, return_inverse=True)[1],
        beams=sweep.name[np.unique(beam)],
        inner=inner,
        edges=edges,
        width_m=settings.footprint_m + settings.divergence_rad * distance,
        first_dark=True,
        squares=False,
        range_sigma_m=settings.range_sigma_m,
        beam_sigma_m=settings.beam_sigma_m,
    )


def with_squares(seen: Seen, first_dark: bool) -> Seen:
    """The same with its squares, the first of them dark or bright."""
    return replace(seen, squares=True, first_dark=first_dark)
