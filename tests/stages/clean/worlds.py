"""A street in which things move, with the class of every point told by where it lies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.clean import ClassCounts, Cleared, FinalLabels, Rays
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Poses
from scanloom.stages.clean import clean, rays, relabel
from scanloom.stages.clean.rays import Settings as RaysSettings
from scanloom.stages.clean.relabel import Settings as RelabelSettings
from scanloom.stages.clean.stage import Settings
from scanloom.stages.geometry.se3 import F8, transform
from tests.worlds import GROUND_Z_M, BoxWorld, observe

PERIOD_NS = 100_000_000
Box = np.ndarray
Thing = Callable[[float], Box]
"""Where something is at a time, s."""


def car(x: float, y: float) -> Box:
    """A car on the ground whose rear right corner is at (x, y)."""
    return np.array([[x, y, GROUND_Z_M + 0.15], [x + 4.3, y + 1.8, GROUND_Z_M + 1.55]])


def wall(x: float, y: float, length: float = 60.0) -> Box:
    return np.array([[x, y, GROUND_Z_M - 1.0], [x + length, y + 6.0, GROUND_Z_M + 6.0]])


@dataclass
class Drive:
    """A session: scans, classes as denoise gives them at its best, poses."""

    scans: list[DeskewedScan]
    labels: list[ScanLabels]
    T: F8

    @property
    def poses(self) -> Poses:
        n = len(self.scans)
        stamps = np.array([s.reference_ns for s in self.scans], np.int64)
        return Poses(np.arange(n), stamps, self.T, np.zeros((n, 6, 6)), np.ones(n, bool), "map", None)

    def world_points(self, scan: int) -> F8:
        return transform(self.T[scan], self.scans[scan].points().astype(float))

    def within(self, scan: int, box: Box, margin_m: float = 0.1) -> np.ndarray:
        """Points of a scan that lie in a box and are no ground."""
        p = self.world_points(scan)
        inside = ((p > box[0] - margin_m) & (p < box[1] + margin_m)).all(axis=1)
        return inside & (self.labels[scan].class_ != PointClass.GROUND)


def drive_past(
    standing: Sequence[Box], moving: Sequence[Thing], *, count: int = 60, step_m: float = 0.8, rows: int = 32,
    columns: int = 512, seed: int = 0, start: F8 | None = None, pose_noise_m: float = 0.0,
    day: int = 0,
) -> Drive:  # fmt: skip
    """Along x among things that stand and things that move; poses may be off by noise that nobody knows of."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4) if start is None else start, (count, 1, 1))
    T[:, 0, 3] += step_m * np.arange(count)
    scans, labels = [], []
    for n in range(count):
        boxes = np.array([*standing, *(thing(0.1 * n) for thing in moving)])
        scan = observe(
            BoxWorld(boxes),
            T[n],
            index=n,
            stamp_ns=n * PERIOD_NS + 10**15 * (1 + day),
            rng=rng,
            rows=rows,
            columns=columns,
        )
        z = transform(T[n], scan.points().astype(float))[:, 2]
        kind = np.where(z < GROUND_Z_M + 0.1, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)
        scans.append(scan)
        labels.append(ScanLabels(kind, scan.reference_ns, n))
    T[:, :3, 3] += pose_noise_m * rng.standard_normal((count, 3))
    return Drive(scans, labels, T)


def rays_of(
    drives: dict[str, Drive], settings: RaysSettings | None = None, chunk: int = 30
) -> dict[str, Parts[Rays]]:
    """What all chunks of all sessions say, by tile."""
    found: dict[str, list] = {}
    for name, drive in drives.items():
        for number, first in enumerate(range(0, len(drive.scans), chunk)):
            rows = slice(first, first + chunk)
            made = rays(
                settings or RaysSettings(),
                Deskewed(drive.scans[rows]),
                Labels(drive.labels[rows]),
                ObjectTracks.empty(),
                drive.poses,
            )
            for part in made:
                where = (("session", name), ("chunk", f"{number:04d}"), ("tile", part.key))
                found.setdefault(part.key, []).append((where, part.product))
    return {tile: Parts(parts) for tile, parts in found.items()}


def cleared_of(
    rays_by_tile: dict[str, Parts[Rays]], settings: Settings | None = None
) -> dict[str, Parts[Cleared]]:
    """Verdicts by session."""
    found: dict[str, list] = {}
    for tile, parts in rays_by_tile.items():
        for part in clean(settings or Settings(), parts):
            found.setdefault(part.key, []).append(((("tile", tile), ("session", part.key)), part.product))
    return {session: Parts(parts) for session, parts in found.items()}


def finals(
    drives: dict[str, Drive], *, rays_settings: RaysSettings | None = None, settings: Settings | None = None,
    tracks: ObjectTracks | None = None, relabel_settings: RelabelSettings | None = None,
) -> dict[str, list[np.ndarray]]:  # fmt: skip
    """Final classes of every scan of every session."""
    cleared = cleared_of(rays_of(drives, rays_settings), settings)
    return {
        name: [label.class_ for label in relabelled(drive, cleared[name], tracks, relabel_settings)[0]]
        for name, drive in drives.items()
    }


def relabelled(
    drive: Drive,
    cleared: Parts[Cleared],
    tracks: ObjectTracks | None = None,
    settings: RelabelSettings | None = None,
) -> tuple[list[ScanLabels], ClassCounts]:
    made = relabel(
        settings or RelabelSettings(), Deskewed(drive.scans), Labels(drive.labels), tracks or ObjectTracks.empty(),
        cleared, drive.poses,
    )  # fmt: skip
    final = next(made)
    assert isinstance(final, FinalLabels)
    labels = list(final)
    counts = next(made)
    assert isinstance(counts, ClassCounts)
    return labels, counts
