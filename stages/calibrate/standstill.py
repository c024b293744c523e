"""Where in a log a board stands still: as long as its corners do, and the LiDAR sees the same.

The corners tell best: people who walk behind the board, or hold it, do not matter. An image that has not changed since
the one before has the same corners, so that few images of a log are searched.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.image import find_corners
from scanloom.stages.geometry.se3 import F8

U1 = NDArray[np.uint8]

_SMALL_PX = 160
"""Width of the image in which changes are looked for."""
_CHANGED, _CHANGED_SHARE = 6.0, 1e-3
"""Grey levels that are a change, and the share of an image that may have one."""
_SAME_PLACE = 3.0
"""Boards nearer to each other than so many times `still_px` stand in the same place."""


class StandstillSettings(BaseModel):
    """When a board stands still, and what is taken of it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spacing_s: float = Field(
        default=0.25,
        ge=0.02,
        le=5.0,
        description="least time between two images of a camera that are looked at, s",
    )
    still_s: float = Field(default=1.0, ge=0.1, le=60.0, description="a board has to stand for so long, s")
    still_px: float = Field(
        default=1.0, ge=0.1, le=20.0, description="corners of a board that stands move less, px"
    )
    margin_s: float = Field(
        default=0.1, ge=0.0, le=5.0, description="left out at both ends of a standstill, s"
    )
    scans: int = Field(
        default=5, ge=1, le=100, description="scans of a standstill that are put together, number"
    )


@dataclass(frozen=True)
class Standstill:
    """A board that stands."""

    start_ns: int
    end_ns: int
    corners: dict[str, F8]
    """Pixels (n, 2) by camera."""
    stamps_ns: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Of the images that show it, by camera."""

    @property
    def middle_ns(self) -> int:
        return (self.start_ns + self.end_ns) // 2

    def image_ns(self, camera: str) -> int | None:
        """Stamp of the image nearest to the middle; None where the camera saw nothing."""
        stamps = self.stamps_ns.get(camera, ())
        return min(stamps, key=lambda stamp: abs(stamp - self.middle_ns), default=None)

    @property
    def length_ns(self) -> int:
        return self.end_ns - self.start_ns


@dataclass
class Watch:
    """One camera's images in order of time, and when the board stood in them."""

    camera: str
    model: CameraModel
    board: Board
    settings: StandstillSettings
    images: int = 0
    boards: int = 0
    """Images that show it."""
    _small: NDArray[np.float32] | None = None
    _corners: F8 | None = None
    _runs: list[Standstill] = field(default_factory=list)
    _last_ns: int = -(1 << 62)

    def wants(self, stamp_ns: int) -> bool:
        """Whether an image of this time is looked at."""
        return stamp_ns - self._last_ns >= 0.9e9 * self.settings.spacing_s

    def look(self, stamp_ns: int, image: U1) -> None:
        """Take in a grey image (h, w)."""
        self._last_ns = stamp_ns
        self.images += 1
        small = _small(image)
        if self._small is None or _changed(small, self._small):
            found = find_corners(image, self.board, self.model, thorough=False)
            self._small, self._corners = small, None if found is None else found.pixels
        if self._corners is None:
            return
        self.boards += 1
        self._extend(stamp_ns, self._corners)

    def _extend(self, stamp_ns: int, corners: F8) -> None:
        last = self._runs[-1] if self._runs else None
        followed = last is not None and stamp_ns - last.end_ns < 2.5e9 * self.settings.spacing_s
        if (
            last is not None
            and followed
            and apart_px(last.corners[self.camera], corners) < self.settings.still_px
        ):
            stamps = {self.camera: (*last.stamps_ns[self.camera], stamp_ns)}
            self._runs[-1] = replace(last, end_ns=stamp_ns, stamps_ns=stamps)
        else:
            self._runs.append(
                Standstill(stamp_ns, stamp_ns, {self.camera: corners}, {self.camera: (stamp_ns,)})
            )

    def standstills(self) -> list[Standstill]:
        """Those that are long enough."""
        return [run for run in self._runs if run.length_ns >= 1e9 * self.settings.still_s]


def standstills(watches: Iterable[Watch], settings: StandstillSettings) -> list[Standstill]:
    """Standstills of all cameras in order of time; one for each place, the longest.

    What several cameras saw at the same time is one standstill, for as long as the board stood in all of them.
    """
    every = sorted(
        (s for watch in watches for s in watch.standstills()), key=lambda s: (s.start_ns, s.end_ns)
    )
    joined: list[Standstill] = []
    for one in every:
        both = _together(joined[-1], one, settings) if joined else None
        if both is None:
            joined.append(one)
        else:
            joined[-1] = both
    places: list[Standstill] = []
    for one in sorted(joined, key=lambda s: -s.length_ns):
        if not any(_same_place(one, other, _SAME_PLACE * settings.still_px) for other in places):
            places.append(one)
    return sorted(places, key=lambda s: s.start_ns)


def _together(a: Standstill, b: Standstill, settings: StandstillSettings) -> Standstill | None:
    """What two cameras saw at the same time."""
    start, end = max(a.start_ns, b.start_ns), min(a.end_ns, b.end_ns)
    if a.corners.keys() & b.corners.keys() or end - start < 0.5e9 * settings.still_s:
        return None
    return Standstill(start, end, a.corners | b.corners, a.stamps_ns | b.stamps_ns)


def _same_place(a: Standstill, b: Standstill, limit_px: float) -> bool:
    common = a.corners.keys() & b.corners.keys()
    return bool(common) and all(apart_px(a.corners[c], b.corners[c]) < limit_px for c in common)


def apart_px(a: F8, b: F8) -> float:
    """How far corners (n, 2) are from the nearest of others (m, 2), px: the largest, in whatever order they are."""
    gap = np.linalg.norm(a[:, None] - b[None], axis=2)
    return float(gap.min(axis=1).max())


def _small(image: U1) -> NDArray[np.float32]:
    import cv2

    height = max(round(image.shape[0] * _SMALL_PX / image.shape[1]), 1)
    return np.asarray(cv2.resize(image, (_SMALL_PX, height), interpolation=cv2.INTER_AREA), np.float32)


def _changed(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """More than noise; another exposure, which bends the tones a little, is no change."""
    if a.shape != b.shape:
        return True
    bent = np.vander(b.ravel() / 255.0, 3)
    tones = np.linalg.lstsq(bent, a.ravel(), rcond=None)[0]
    return bool((np.abs(a.ravel() - bent @ tones) > _CHANGED).mean() > _CHANGED_SHARE)
