"""Views: what every image of a stretch says of every point that it sees, and which of them agree."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]
I8 = NDArray[np.int64]

MOST_VIEWS = 512
"""Of one point; more are not asked. A stretch has fewer images of each camera."""


@dataclass(frozen=True)
class Views:
    """Views (n,), ordered by point."""

    point: I4
    """Number of the point, over all tiles."""
    image: I4
    """Number of the image in its stretch."""
    camera: I4
    cell: I4
    """Of the camera's picture, see `cells_of`."""
    ring: I4
    """How far from the middle of the picture, 0 inside; see `rings_of`."""
    away: F4
    """From the camera, m."""
    light: F4
    """(n, 3) logarithm of linear red, green, blue."""
    weight: F4
    surely: NDArray[np.bool_]
    """Seen so clearly that no other image need agree."""

    def __len__(self) -> int:
        return len(self.point)

    def take(self, rows: NDArray[np.bool_] | I8) -> Views:
        return Views(*(np.ascontiguousarray(getattr(self, field.name)[rows]) for field in fields(self)))

    @property
    def starts(self) -> I8:
        """First view of each point that has any, and one past the last."""
        return np.append(np.flatnonzero(np.diff(self.point, prepend=-1)), len(self)).astype(np.int64)


def alone(views: Views) -> NDArray[np.bool_]:
    """Which views (n,) are the only one of their point."""
    count = np.diff(views.starts)
    return np.asarray(np.repeat(count == 1, count))


class Gathered:
    """Views on their way in, image by image."""

    def __init__(self) -> None:
        self._parts: list[Views] = []

    def __len__(self) -> int:
        return len(self._parts)

    def add(self, views: Views) -> None:
        self._parts.append(views)

    def ordered(self) -> Views:
        """All of them by point; of one point in the order in which they came."""
        columns = [
            np.concatenate([getattr(part, field.name) for part in self._parts]) for field in fields(Views)
        ]
        self._parts = []
        return Views(*columns).take(np.argsort(columns[0], kind="stable"))


def off_consensus(views: Views, light: F4) -> F4:
    """How far each view (n,) is from what the views of its point mostly say: the largest difference of the three
    logarithms `light` (n, 3) to their weighted medians."""
    return _off_consensus(views.starts, light, np.sqrt(views.weight))


@kernel
def _off_consensus(starts: I8, light: F4, weight: F4) -> F4:
    off = np.zeros(len(weight), np.float32)
    for p in range(len(starts) - 1):
        first, last = starts[p], min(starts[p + 1], starts[p] + MOST_VIEWS)
        if last - first < 2:
            continue
        half = np.float32(0.5) * weight[first:last].sum()
        for c in range(3):
            values = light[first:last, c].copy()
            order = np.argsort(values)
            met = np.float32(0.0)
            middle = values[order[0]]
            for k in order:
                met += weight[first + k]
                middle = values[k]
                if met >= half:
                    break
            for k in range(first, last):
                off[k] = max(off[k], abs(light[k, c] - middle))
    return off
