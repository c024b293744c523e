"""A world of boxes of which some move, filmed by a LiDAR with exact poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Extrinsic, Session
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.boxes import inside_boxes
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.objects import Settings, objects
from tests.worlds import GROUND_Z_M, BoxWorld, observe

BEAMS, COLUMNS = 24, 720
PERIOD_S = 0.1
START_NS = 1_700_000_000_000_000_000
CAR = (4.4, 1.8, 1.5)
PERSON = (0.5, 0.5, 1.8)
FAR_WALL = [[-80.0, 60.0, GROUND_Z_M], [80.0, 61.0, 8.0]]


def box(x: float, y: float, size: tuple[float, float, float] = CAR) -> list[list[float]]:
    """Corners of a box on the ground with its middle at (x, y) and its length along x."""
    a, b, h = size
    return [[x - a / 2, y - b / 2, GROUND_Z_M], [x + a / 2, y + b / 2, GROUND_Z_M + h]]


@dataclass(frozen=True)
class Film:
    """What was seen, and where from."""

    scans: list[DeskewedScan]
    labels: list[ScanLabels]
    T_world_lidar: F8
    T_base_lidar: F8
    boxes: list[F8]
    """Of each scan."""

    def tracks(
        self, *, settings: Settings | None = None, segments: Sequence[int] | None = None, left_out: Sequence[int] = (),
        chunk: int = 20,
    ) -> ObjectTracks:  # fmt: skip
        """Run the stage, in chunks of scans; scans that are left out have no pose."""
        return objects(
            settings or Settings(), parts(Deskewed, self.scans, chunk), parts(Labels, self.labels, chunk),
            session(self.T_base_lidar), self.odometry(segments, left_out),
        )  # fmt: skip

    def odometry(self, segments: Sequence[int] | None, left_out: Sequence[int]) -> Odometry:
        """Exact poses, in a frame that begins with the first scan's."""
        n = len(self.scans)
        T = inverse(self.T_world_lidar[0]) @ self.T_world_lidar if n else np.zeros((0, 4, 4))
        blank = Odometry.empty()
        columns = {
            name: np.zeros((n, *getattr(blank, name).shape[1:]), getattr(blank, name).dtype)
            for name in columns_of(Odometry)
        }
        columns["scan_index"] = np.arange(n)
        columns["stamp_ns"] = START_NS + np.arange(n) * round(PERIOD_S * 1e9)
        columns["T_odom_lidar"] = np.ascontiguousarray(T)
        columns["segment"] = np.array(segments if segments is not None else [0] * n, np.int32)
        return Odometry(**columns).take(np.setdiff1d(np.arange(n), left_out))

    def covered(self, tracks: ObjectTracks, which: int) -> float:
        """Share of the points of one of the boxes that lie in a dynamic box of their scan."""
        own, held = 0, 0
        for k, scan in enumerate(self.scans):
            low, high = self.boxes[k][which]
            T = self.T_world_lidar[k]
            world = scan.points() @ T[:3, :3].T + T[:3, 3]
            true = ((world > low - 0.06) & (world < high + 0.06)).all(axis=1) & (
                self.labels[k].class_ == PointClass.STATIC
            )
            rows = (tracks.scan_index == k) & tracks.dynamic
            inside = inside_boxes(scan.x_m, scan.y_m, scan.z_m, tracks.take(rows).boxes(), 0.3) >= 0
            own, held = own + int(true.sum()), held + int((true & inside).sum())
        assert own > 100
        return held / own


def film(
    poses: F8, boxes_at: Callable[[float], Sequence[list[list[float]]]], *, seed: int = 0, upside_down: bool = False
) -> Film:  # fmt: skip
    """One scan per pose (n, 4, 4) of a level LiDAR; the boxes of the world at each time, s."""
    rng = np.random.default_rng(seed)
    T_base_lidar = np.eye(4)
    T_base_lidar[2, 3] = -GROUND_Z_M
    if upside_down:
        T_base_lidar[:3, :3] = np.diag([1.0, -1.0, -1.0])
    turned = np.eye(4)
    turned[:3, :3] = T_base_lidar[:3, :3]
    scans, labels, worlds = [], [], []
    for k, T in enumerate(poses):
        boxes = np.array([*boxes_at(k * PERIOD_S), FAR_WALL])
        stamp_ns = START_NS + k * round(PERIOD_S * 1e9)
        scan = observe(BoxWorld(boxes), T, index=k, stamp_ns=stamp_ns, rng=rng, rows=BEAMS, columns=COLUMNS)
        ground = scan.points() @ T[2, :3] + T[2, 3] < GROUND_Z_M + 0.12
        if upside_down:
            scan = DeskewedScan(
                x_m=scan.x_m, y_m=-scan.y_m, z_m=-scan.z_m, intensity=scan.intensity,
                reference_ns=scan.reference_ns, scan_index=k,
            )  # fmt: skip
        class_ = np.where(ground, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)
        scans.append(scan)
        labels.append(ScanLabels(class_=class_, reference_ns=scan.reference_ns, scan_index=k))
        worlds.append(boxes)
    return Film(scans, labels, poses @ turned, T_base_lidar, worlds)


def parts(product, items, chunk):  # type: ignore[no-untyped-def]
    """Items cut into chunks, as the engine hands them over."""
    cut = [items[k : k + chunk] for k in range(0, max(len(items), 1), chunk)]
    return Parts(
        [((("session", "test"), ("chunk", f"{k:04d}")), product(piece)) for k, piece in enumerate(cut)]
    )


def session(T_base_lidar: F8) -> Session:
    lidar = Extrinsic(sensor="lidar", T_base_sensor=tuple(map(tuple, T_base_lidar.tolist())), source="test")
    return Session(
        name="test", format="mcap", start_ns=0, end_ns=10**9, scan_count=1, point_count=1, scan_rate_hz=10.0,
        beams=BEAMS, point_time="per point", topics=(), extrinsics=(lidar,), problems=(), complete=True,
    )  # fmt: skip


def straight(count: int, speed_m_s: float = 0.0, yaw_rate_rad_s: float = 0.0) -> F8:
    """Level poses (count, 4, 4) along x, or on an arc."""
    T = np.tile(np.eye(4), (count, 1, 1))
    yaw, place = 0.0, np.zeros(2)
    for k in range(count):
        c, s = np.cos(yaw), np.sin(yaw)
        T[k, :2, :2] = [[c, -s], [s, c]]
        T[k, :2, 3] = place
        place = place + speed_m_s * PERIOD_S * np.array([c, s])
        yaw += yaw_rate_rad_s * PERIOD_S
    return T
