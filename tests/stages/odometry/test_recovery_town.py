"""Survival in the simulated town: LiDAR alone, two scans a second, at the speed of a car."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse, se3_log
from scanloom.stages.odometry import Settings, odometry
from scanloom.workflows.build_map import Order, request_of

DRIVE = {"duration_s": 12.0, "beams": 32, "columns": 512, "standstill_s": 0.0, "start_m": 60.0}
NODES = ("simulate", "truth", "ingest", "sensors", "deskew", "denoise")


@dataclasses.dataclass(frozen=True)
class Town:
    scans: list[DeskewedScan]
    labels: list[ScanLabels]
    session: Session
    truth: Truth

    def steps(self, every: int, first: int) -> tuple[F8, np.ndarray, np.ndarray]:
        """Errors (n, 6) of the motions between every so many scans; length of the motions, m; which rows are reliable."""
        chosen = slice(first, None, every)
        where = (("session", "a"), ("chunk", "0000"))
        track = odometry(
            Settings(), Parts([(where, Deskewed(self.scans[chosen]))]), Parts([(where, Labels(self.labels[chosen]))]),
            self.session, Imu.empty(), Wheel.empty(),
        )  # fmt: skip
        assert not track.segment.any()
        truth = interpolate_poses(self.truth.stamp_ns, self.truth.T_truth_lidar, track.stamp_ns)
        wanted = inverse(truth[:-1]) @ truth[1:]
        errors = se3_log(inverse(wanted) @ inverse(track.T_odom_lidar[:-1]) @ track.T_odom_lidar[1:])
        return errors, np.linalg.norm(wanted[:, :3, 3], axis=1), track.reliable


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    folder = tmp_path_factory.mktemp("town")
    order = Order(
        sessions=("sample",), out=folder / "out", name="sample", store=folder / "store", cluster="none",
        command_line={"simulate": DRIVE},
    )  # fmt: skip
    request, errors = request_of(order)
    assert not errors
    request = dataclasses.replace(request, nodes=tuple(n for n in request.nodes if n.name in NODES))
    done = run(request, Store(folder / "store"), cluster="none")
    assert not done.failures

    def files(pattern: str) -> list[Path]:
        return sorted((folder / "store").glob(pattern))

    clouds, classes = files("deskew/*/deskewed.parquet"), files("denoise/*/labels.parquet")
    scans = sorted((s for path in clouds for s in Deskewed.open(path)), key=lambda s: s.scan_index)
    labels = sorted((s for path in classes for s in Labels.open(path)), key=lambda s: s.scan_index)
    return Town(
        scans, labels, Session.open(files("ingest/*/session.json")[0]), Truth.open(files("truth/*/truth.parquet")[0])
    )  # fmt: skip


@pytest.mark.parametrize(("every", "first"), [(5, 0), (5, 40), (8, 40)])
def test_few_scans_a_second_are_followed(town: Town, every: int, first: int) -> None:
    """From a standstill, and beginning in full drive."""
    errors, step_m, reliable = town.steps(every, first)
    assert step_m.max() > 2.4
    assert reliable.all()
    off = np.linalg.norm(errors[:, 3:], axis=1)
    assert off.max() < 0.1
    assert 0.001 < np.sqrt((off**2).mean()) < 0.05
