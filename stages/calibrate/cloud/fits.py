"""The best fit of a board from several starts, with its squares where they can be seen."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.cloud.candidate import Seen, with_squares
from scanloom.stages.calibrate.cloud.hits import trimmed
from scanloom.stages.calibrate.cloud.misfit import agreement, contrast_of
from scanloom.stages.calibrate.cloud.pose import PoseFit, fitted
from scanloom.stages.calibrate.cloud.settings import CloudSettings
from scanloom.stages.geometry.se3 import F8, pose

_LEAST_CONTRAST = 0.35
"""Correlation of the reflectance with the print from which squares count as seen."""
_FAINT_CONTRAST = 0.2
"""The same before the fit."""
_CLEARLY_LESS = 0.3
_SHIFTS = np.linspace(-1.25, 1.25, 11)
"""Squares by which starts are shifted where the edges leave the place open."""


def best_fit(seen: Seen, starts: list[F8], settings: CloudSettings) -> PoseFit:
    """The best of the fits from all starts: by edges first, then with the squares where they can be seen."""
    rough = [fitted(seen, T, rounds=2) for T in starts]
    if settings.reflectance != "ignore" and np.ptp(seen.intensity) > 0:
        fit = _by_squares(seen, rough)
        if fit is not None and fit.contrast > _LEAST_CONTRAST:
            return fit
    T = min(rough, key=lambda fit: fit.cost).T_lidar_board
    return fitted(trimmed(seen, T), T)


def _by_squares(seen: Seen, rough: list[PoseFit]) -> PoseFit | None:
    """The fit from where edges and squares agree best; None where nowhere near any squares are to be seen."""
    starts = [T for fit in rough for T in _shifted(seen, fit)]
    found = []
    for squares in (with_squares(seen, True), with_squares(seen, False)):
        T = max(starts, key=lambda T: agreement(squares, T))
        found.append((contrast_of(squares, T), squares, T))
    clearest = max(contrast for contrast, _, _ in found)
    if clearest < _FAINT_CONTRAST:
        return None
    fits_of = [
        fitted(squares, T, rounds=2) for contrast, squares, T in found if contrast > clearest - _CLEARLY_LESS
    ]
    best = max(fits_of, key=lambda fit: agreement(fit.seen, fit.T_lidar_board))
    return fitted(trimmed(best.seen, best.T_lidar_board), best.T_lidar_board)


def _shifted(seen: Seen, fit: PoseFit) -> list[F8]:
    """The start, and others around it within the plane as far as the edges allow."""
    T, size = fit.T_lidar_board, seen.board.square_m
    sigma = np.sqrt(np.diag(fit.covariance)[3:5])
    x, y = (_SHIFTS[np.abs(_SHIFTS) * size <= max(4 * s, 0.3 * size)] for s in sigma)
    return [T @ pose(np.eye(3), [i * size, j * size, 0.0]) for i in x for j in y]
