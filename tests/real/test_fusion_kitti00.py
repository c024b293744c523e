"""Real odometry and real GNSS positions of 3.7 km of KITTI 00: fusion must do better than odometry alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.product import Parts
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import inverse, matrix_from_quaternion, pose
from tests.stages.fusion.drives import ate, loops_of, parts

pytestmark = pytest.mark.real

START_NS = 1_317_000_000_000_000_000
TIME_OFFSET_S = -0.6
"""GNSS stamps against the scans', found by the best rigid fit of truth to the fixes (see the data's description)."""
ORIGIN = georeference(48.98, 8.39, 116.0)


def forward_left_up(tum: np.ndarray) -> np.ndarray:
    """Camera poses (n, 4, 4) of a TUM file (x right, y down, z forward) with axes forward, left, up."""
    axes = pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    T = pose(matrix_from_quaternion(tum[:, [7, 4, 5, 6]]), tum[:, 1:4])
    return axes @ T @ inverse(axes)


@pytest.fixture(scope="module")
def drive(shared_data: Path) -> tuple[Odometry, Gnss, np.ndarray]:
    folder = shared_data / "kitti_00_trajectory"
    track = np.loadtxt(folder / "kiss_icp_tum.txt")
    truth = np.loadtxt(folder / "truth_tum.txt")
    T = forward_left_up(track)
    n = len(T)
    sigma = np.repeat([np.radians(0.02), 0.02], 3)
    moved = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))))
    odometry = Odometry(
        scan_index=np.arange(n), stamp_ns=START_NS + (track[:, 0] * 1e9).astype(np.int64), T_odom_lidar=T,
        covariance=np.broadcast_to(np.diag(sigma**2), (n, 6, 6)).copy(), inlier_ratio=np.ones(n), rmse_m=np.zeros(n),
        degeneracy_d=np.ones(n), degeneracy_e=np.zeros(n), direction_p=np.ones((n, 6)),
        weak_directions=np.broadcast_to(np.eye(6), (n, 6, 6)).copy(),
        keyframe=np.concatenate(([True], np.diff(np.floor(moved / 2)) > 0)), reliable=np.ones(n, bool),
        segment=np.zeros(n, np.int32),
    )  # fmt: skip
    fixes = np.loadtxt(folder / "gnss_enu_1hz.csv", delimiter=",", skiprows=1)
    time_s = fixes[:, 0] - fixes[0, 0] + TIME_OFFSET_S
    geodetic = world_to_geodetic(ORIGIN, fixes[:, 1:])
    m = len(fixes)
    gnss = Gnss(
        stamp_ns=START_NS + (time_s * 1e9).astype(np.int64), latitude_deg=geodetic[:, 0].copy(),
        longitude_deg=geodetic[:, 1].copy(), height_m=geodetic[:, 2].copy(),
        covariance_m2=np.broadcast_to(np.diag([0.5, 0.5, 1.0]) ** 2, (m, 3, 3)).copy(), status=np.zeros(m, np.int8),
        satellites=np.full(m, -1, np.int16),
    )  # fmt: skip
    return odometry, gnss, forward_left_up(truth)


def test_gnss_takes_the_drift_out(drive: tuple[Odometry, Gnss, np.ndarray]) -> None:
    odometry, gnss, truth = drive
    session = Session(
        name="00", format="kitti odometry", start_ns=int(odometry.stamp_ns[0]), end_ns=int(odometry.stamp_ns[-1]),
        scan_count=len(odometry), point_count=0, scan_rate_hz=10.0, beams=64, point_time="none", topics=(),
        extrinsics=(), problems=(), complete=True,
    )  # fmt: skip
    out = list(
        fusion(
            Settings(),
            parts(a=session),
            parts(a=odometry),
            loops_of([]),
            parts(a=gnss),
            Parts([((("session", "a"),), Imu.empty())]),
        )
    )
    poses, graph = out[0].product, out[1]
    alone, fused = ate(odometry.T_odom_lidar, truth), ate(poses.T_world_lidar, truth)
    used = (graph.kind == "gnss") & (graph.verdict == "used")
    assert alone == pytest.approx(3.5, abs=0.2)
    assert 0.1 < fused < 1.0
    assert poses.georeference["epsg"] == 32632
    assert used.sum() > 250
