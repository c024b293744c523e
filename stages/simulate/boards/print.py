"""What is printed on a board, and where its corners and its outline are.

The board's frame: origin in the middle of the pattern, x along the first dimension, y along the second, z out of the
print.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

BLACK, WHITE = 0.03, 0.8
"""Share of the light that comes back."""
THICK_M = 0.008


@dataclass(frozen=True)
class Print:
    """A chessboard on a plate."""

    inner_corners: tuple[int, int]
    square_m: float
    board_m: tuple[float, float]
    offset_m: tuple[float, float]

    def corners_m(self) -> F8:
        """Inner corners (m*n, 3), m; corner (i, j) is row i*n + j, x grows with i, y with j."""
        m, n = self.inner_corners
        i, j = np.divmod(np.arange(m * n), n)
        x, y = (i - (m - 1) / 2) * self.square_m, (j - (n - 1) / 2) * self.square_m
        return np.column_stack((x, y, np.zeros(m * n)))

    def outline_m(self) -> F8:
        """Vertices (4, 3) of the plate, m, counter-clockwise from (-x, -y)."""
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
        return np.column_stack(
            (np.asarray(self.offset_m) + signs * np.asarray(self.board_m) / 2, np.zeros(4))
        )

    def dark(self, x: F8, y: F8) -> NDArray[np.bool_]:
        """Whether places (n,) of the plate are black."""
        m, n = self.inner_corners
        i = np.floor(x / self.square_m + (m + 1) / 2).astype(int)
        j = np.floor(y / self.square_m + (n + 1) / 2).astype(int)
        within = (i >= 0) & (i <= m) & (j >= 0) & (j <= n)
        return np.asarray(within & ((i + j) % 2 == 0))

    def other(self) -> Print:
        """Another board of nearly the same plate: one corner less on a side, smaller squares."""
        m, n = self.inner_corners
        return Print((max(m - 1, 2), n), 0.9 * self.square_m, self.board_m, (0.0, 0.0))
