"""One place where a board stood still in a log: the scans and images that are taken of it."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

import numpy as np

from scanloom.schemas.scans import Scan
from scanloom.stages.calibrate.standstill import Standstill, StandstillSettings
from scanloom.stages.images.packing import packed
from scanloom.stages.logs.records import AnyImage
from scanloom.workflows.calibration_folder import PointCloud


@dataclass(frozen=True)
class LogPlacement:
    """A board that stood still in a log."""

    name: str
    points: PointCloud
    images: dict[str, bytes]
    log: str

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.images)

    def cloud(self) -> PointCloud:
        return self.points

    def image(self, camera: str) -> bytes:
        return self.images[camera]

    def where(self, camera: str) -> str:
        return f"{self.log}, camera {camera} at {self.name}"


@dataclass
class Place:
    """What is kept of a standstill while a log goes by: what is nearest to its middle."""

    still: Standstill
    scans: list[tuple[int, int, Scan]] = field(default_factory=list)
    """A heap, the farthest from the middle first."""
    images: dict[str, AnyImage] = field(default_factory=dict)

    def note_scan(self, scan: Scan, settings: StandstillSettings) -> None:
        margin_ns = round(1e9 * settings.margin_s)
        first, last = int(scan.stamp_ns.min()), int(scan.stamp_ns.max())
        if first < self.still.start_ns + margin_ns or last > self.still.end_ns - margin_ns:
            return
        gap = abs(scan.reference_ns - self.still.middle_ns)
        heapq.heappush(self.scans, (-gap, scan.reference_ns, scan))
        if len(self.scans) > settings.scans:
            heapq.heappop(self.scans)

    def note_image(self, camera: str, stamp_ns: int, body: AnyImage) -> None:
        if stamp_ns == self.still.image_ns(camera):
            self.images.setdefault(camera, body)

    def cloud(self) -> PointCloud:
        scans = [scan for _, _, scan in sorted(self.scans, key=lambda entry: entry[1])]
        points = np.concatenate([np.column_stack((s.x_m, s.y_m, s.z_m)) for s in scans]).astype(np.float64)
        ring = np.concatenate([s.ring for s in scans]).astype(np.int64)
        return PointCloud(
            points,
            np.concatenate([s.intensity for s in scans]).astype(np.float64),
            ring if len(np.unique(ring)) > 1 else None,
        )

    def encoded(self) -> dict[str, bytes]:
        return {camera: packed(body)[0].tobytes() for camera, body in sorted(self.images.items())}
