"""How dark the print is under a beam of some width."""

from __future__ import annotations

import numpy as np

from scanloom.stages.calibrate.board import Board
from scanloom.stages.geometry.se3 import F8


def dark_share(board: Board, first_dark: bool, xy: F8, blur_m: F8) -> F8:
    """Share (n,) of dark print under Gaussian beams of standard deviation `blur_m` (n,) at points (n, 2) of the board.

    Square (0, 0), at the lowest x and y, is dark or bright; all squares that stand on the inner corners are printed, and
    what is outside is bright. A blurred product of functions of x and of y is the product of both blurred.
    """
    along = [_blurred(board.squares[k], board.square_m, xy[:, k], blur_m) for k in range(2)]
    inside, waves = along[0][0] * along[1][0], along[0][1] * along[1][1]
    out: F8 = 0.5 * (inside + (waves if first_dark else -waves))
    return out


def _blurred(squares: int, size: float, x: F8, blur: F8) -> tuple[F8, F8]:
    """Of one axis: the pattern's extent (1 within), and +1, -1, ... from square to square, both blurred."""
    from scipy.special import ndtr

    ends = (np.arange(squares + 1) - squares / 2) * size
    step = ndtr((x[:, None] - ends) / blur[:, None])
    share = step[:, :-1] - step[:, 1:]
    return share.sum(axis=1), share @ np.where(np.arange(squares) % 2, -1.0, 1.0)
