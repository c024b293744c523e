"""What a calibration starts from: every placement of the board, as the LiDAR and each camera saw it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.image import ImageBoard
from scanloom.stages.calibrate.rays import Bearings
from scanloom.stages.calibrate.view import I8, LidarView, all_beams
from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class Placement:
    """One place where the board stood; `images` by camera."""

    name: str
    cloud: LidarView
    images: Mapping[str, ImageBoard]
    others: tuple[LidarView, ...] = ()
    """More boards in its cloud; the images may be of one of these."""

    def without(self, cameras: Iterable[str]) -> Placement:
        """The same without the images of these cameras."""
        left_out = set(cameras)
        return replace(
            self, images={name: seen for name, seen in self.images.items() if name not in left_out}
        )


@dataclass(frozen=True)
class Scene:
    """All evidence."""

    board: Board
    models: Mapping[str, CameraModel]
    placements: tuple[Placement, ...]
    beams: I8
    """Names of the LiDAR's beams on any board, sorted; a part of a scene keeps those of all of it."""

    @classmethod
    def of(cls, board: Board, models: Mapping[str, CameraModel], placements: tuple[Placement, ...]) -> Scene:
        """A scene of all there is."""
        return cls(
            board, models, placements, all_beams([v for p in placements for v in (p.cloud, *p.others)])
        )

    def only(self, names: Iterable[str]) -> Scene:
        """Some of the placements, and the cameras that still see one."""
        wanted = set(names)
        return self._of(tuple(p for p in self.placements if p.name in wanted))

    def without(self, sightings: Iterable[tuple[str, str]]) -> Scene:
        """Without some pairs (placement, camera), and without placements that no camera is left for."""
        gone = set(sightings)
        thinned = (p.without(c for c in p.images if (p.name, c) in gone) for p in self.placements)
        return self._of(tuple(p for p in thinned if p.images))

    def _of(self, placements: tuple[Placement, ...]) -> Scene:
        seen = {camera for p in placements for camera in p.images}
        return Scene(self.board, {c: m for c, m in self.models.items() if c in seen}, placements, self.beams)

    def bearings(self) -> dict[tuple[str, str], Bearings]:
        """Corners as directions, by placement and camera."""
        return {
            (p.name, camera): Bearings.of(self.models[camera], seen.pixels)
            for p in self.placements
            for camera, seen in p.images.items()
        }

    def corners(self, placement: Placement, camera: str) -> F8:
        """Corners (n, 3) of the board, in its frame, that the camera saw there."""
        return self.board.corners_m()[placement.images[camera].index]

    def seen_by(self, camera: str) -> tuple[Placement, ...]:
        return tuple(p for p in self.placements if camera in p.images)

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(sorted(self.models))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.placements)
