"""Plan views: the tracks from above in the colours of the page, with room for marks on them."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.trajectory import Poses
from scanloom.stages.report.overlay import SESSION_COLOURS, round_length
from scanloom.stages.report.raster import View, fit_view

F8 = NDArray[np.float64]

_WIDTH = 1000
_MAX_PATH_POINTS = 1500
_MARGIN = 0.06
_LEAST_MARGIN_M = 3.0
_KILOMETRE_M = 1000


class Plan:
    """A window that shows all tracks; needs at least one pose."""

    def __init__(self, paths: Mapping[str, Poses]) -> None:
        self._paths = paths
        corners = np.concatenate([poses.T_world_lidar[:, :2, 3] for poses in paths.values() if len(poses)])
        low, high = corners.min(axis=0), corners.max(axis=0)
        margin = max(float((high - low).max()) * _MARGIN, _LEAST_MARGIN_M)
        self.view: View = fit_view(low, high, margin, _WIDTH, 1e-3)
        self._bar_m = round_length(self.view.width * self.view.pixel_m / 5)

    @property
    def scale(self) -> str:
        """How long the bar at the lower left is."""
        if self._bar_m >= _KILOMETRE_M:
            return f"{self._bar_m / _KILOMETRE_M:g} km"
        return f"{self._bar_m:g} m"

    def draw(self, marks: str, label: str) -> str:
        """The tracks with marks, in pixels of `view`, on them."""
        tracks = "".join(
            self._track(number, name, poses)
            for number, (name, poses) in enumerate(self._paths.items())
            if len(poses)
        )
        return (
            f'<svg viewBox="0 0 {self.view.width} {self.view.height}" class="plan" role="img" '
            f'aria-label="{escape(label)}">{tracks}{marks}{self._bar()}</svg>'
        )

    def _track(self, number: int, name: str, poses: Poses) -> str:
        count = min(len(poses), _MAX_PATH_POINTS)
        rows = np.unique(np.linspace(0, len(poses) - 1, count).round().astype(int))
        xy = self.view.pixels(poses.T_world_lidar[rows, :2, 3])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in xy.tolist())
        style = f"track track-{number % len(SESSION_COLOURS)}" if len(self._paths) > 1 else "track"
        return f'<polyline points="{points}" class="{style}"><title>{escape(name)}</title></polyline>'

    def _bar(self) -> str:
        view = self.view
        x, y = 0.02 * view.width, view.height - 0.02 * view.width
        return f'<path d="M{x:.1f} {y - 8:.1f}v8h{self._bar_m / view.pixel_m:.1f}v-8" class="bar-line"/>'


def drawable(paths: Mapping[str, Poses]) -> bool:
    """Whether there is a pose to draw."""
    return any(len(poses) for poses in paths.values())
