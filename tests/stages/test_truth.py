"""True trajectories from every source, against poses that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import TruthLog
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.se3 import inverse, pose, quaternion_from_matrix, se3_exp, so3_exp
from scanloom.stages.truth import T_CAMERA_LIDAR, Settings, truth
from tests.stages.logs.kitti_folder import names_of, oxts_line, raw_drive


def log_of(root: Path) -> TruthLog:
    return TruthLog(root=root, names=names_of(root))


def arc(count: int = 20) -> np.ndarray:
    """LiDAR poses (n, 4, 4) along a climbing arc, the first at the origin."""
    step = se3_exp([0.01, -0.005, 0.05, 1.0, 0.02, 0.01])
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def tum_text(T: np.ndarray, start: int = 1_700_000_000) -> str:
    q = quaternion_from_matrix(T[:, :3, :3])
    lines = ["# stamp tx ty tz qx qy qz qw"]
    for i, (t, (w, x, y, z)) in enumerate(zip(T[:, :3, 3], q)):
        lines.append(f"{start + i}.{123456789 + i:09d} " + " ".join(f"{v:.12f}" for v in (*t, x, y, z, w)))
    return "\n".join(lines) + "\n"


def test_no_files_give_no_rows() -> None:
    found = truth(Settings(), TruthLog())
    assert (len(found), found.source) == (0, "none")


def test_the_simulators_trajectory_is_taken_as_it_is(tmp_path: Path) -> None:
    made = Truth(stamp_ns=np.arange(20, dtype=np.int64), T_truth_lidar=arc(), source="simulator")
    made.write(tmp_path / "trajectory.parquet")
    (tmp_path / "classes.txt").write_text("1 2 3 4 5 6 7 8\n")
    found = truth(Settings(), log_of(tmp_path))
    np.testing.assert_array_equal(found.T_truth_lidar, made.T_truth_lidar)
    assert found.source == "simulator"


def test_tum_poses_of_the_lidar_keep_every_nanosecond(tmp_path: Path) -> None:
    (tmp_path / "truth.tum").write_text(tum_text(arc()))
    found = truth(Settings(), log_of(tmp_path))
    np.testing.assert_allclose(found.T_truth_lidar, arc(), atol=1e-10)
    assert found.stamp_ns[3] == 1_700_000_003_123_456_792


def test_tum_stamps_can_be_moved_and_are_put_in_order(tmp_path: Path) -> None:
    lines = tum_text(arc()).splitlines()
    (tmp_path / "truth.txt").write_text("\n".join([lines[0], *reversed(lines[1:]), lines[5]]))
    found = truth(Settings(time_offset_s=-0.5), log_of(tmp_path))
    assert len(found) == 20
    assert (np.diff(found.stamp_ns) > 0).all()
    assert found.stamp_ns[0] == 1_699_999_999_623_456_789
    np.testing.assert_allclose(found.T_truth_lidar, arc(), atol=1e-10)
    assert "-0.500 s" in found.source


def test_tum_poses_of_a_camera_start_at_the_lidar(tmp_path: Path) -> None:
    """Camera poses made from known LiDAR poses come back as these, whether the distance is known or not."""
    T_camera_lidar = pose(T_CAMERA_LIDAR[:3, :3] @ so3_exp([0.02, -0.01, 0.03]), [0.1, -0.2, -0.3])
    T_camera = T_camera_lidar @ arc() @ inverse(T_camera_lidar)
    (tmp_path / "truth.txt").write_text(tum_text(T_camera))
    numbers = " ".join(f"{v:.12g}" for v in T_camera_lidar[:3].ravel())
    (tmp_path / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")
    found = truth(Settings(poses_of="camera"), log_of(tmp_path))
    np.testing.assert_allclose(found.T_truth_lidar, arc(), atol=1e-9)
    (tmp_path / "calib.txt").unlink()
    rough = truth(Settings(poses_of="camera"), log_of(tmp_path))
    error = np.linalg.norm(rough.T_truth_lidar[:, :3, 3] - arc()[:, :3, 3], axis=1)
    assert 0.05 < error.max() < 1.5
    assert "not known" in rough.source


def test_tum_poses_of_another_sensor(tmp_path: Path) -> None:
    T_sensor_lidar = pose(so3_exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    (tmp_path / "truth.txt").write_text(tum_text(arc() @ inverse(T_sensor_lidar)))
    settings = Settings(poses_of="sensor", T_sensor_lidar=tuple(map(tuple, T_sensor_lidar.tolist())))
    found = truth(settings, log_of(tmp_path))
    np.testing.assert_allclose(found.T_truth_lidar, arc(), atol=1e-9)


@pytest.mark.parametrize("place", ["poses.txt", "poses/00.txt"])
def test_kitti_odometry_poses(tmp_path: Path, place: str) -> None:
    T_camera_lidar = pose(T_CAMERA_LIDAR[:3, :3], [0.0, -0.08, -0.27])
    T_camera = T_camera_lidar @ arc() @ inverse(T_camera_lidar)
    (tmp_path / place).parent.mkdir(exist_ok=True)
    sequence = tmp_path / "sequences/00"
    sequence.mkdir(parents=True)
    (tmp_path / place).write_text(
        "".join(" ".join(f"{v:.12e}" for v in T[:3].ravel()) + "\n" for T in T_camera)
    )
    numbers = " ".join(f"{v:.12e}" for v in T_camera_lidar[:3].ravel())
    (sequence / "calib.txt").write_text(f"Tr: {numbers}\n")
    (sequence / "times.txt").write_text("".join(f"{i * 0.1:e}\n" for i in range(20)))
    found = truth(Settings(), log_of(tmp_path))
    np.testing.assert_allclose(found.T_truth_lidar, arc(), atol=1e-9)
    assert found.stamp_ns[3] == 300_000_000
    (sequence / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(InvalidInput, match="2 times for 20 poses"):
        truth(Settings(), log_of(tmp_path))


def test_oxts_gives_the_lidar_not_the_imu(tmp_path: Path) -> None:
    """A car that drives east at 10 m/s, turned by its yaw: steps of a metre, LiDAR ahead of and above the IMU."""
    found = truth(Settings(), log_of(raw_drive(tmp_path, 10)))
    steps = np.diff(found.T_truth_lidar[:, :3, 3], axis=0)
    np.testing.assert_allclose(steps, np.tile([1.0, 0, 0], (9, 1)), atol=4e-3)
    # East along a parallel is the car's forward: yaw 0. The LiDAR sits 0.81 ahead, 0.32 right and 0.80 above the IMU.
    np.testing.assert_allclose(found.T_truth_lidar[0, :3, 3], [0.81, -0.32, 0.80], atol=0.03)
    np.testing.assert_allclose(found.T_truth_lidar[0, 2, :3], [0.02, 0.01, 1.0], atol=1e-3)
    assert "0.40" in found.source
    assert "not independent" in found.source


def test_oxts_attitude_follows_the_development_kit(tmp_path: Path) -> None:
    raw_drive(tmp_path, 2)
    words = oxts_line(0).split()
    words[3:6] = ["0.0", "0.1", str(np.pi / 2)]
    for i in range(2):
        (tmp_path / f"2011_09_26_drive_0005_sync/oxts/data/{i:010d}.txt").write_text(" ".join(words))
    R = truth(Settings(), log_of(tmp_path)).T_truth_lidar[0, :3, :3]
    # Yaw 90 degrees faces north; positive pitch puts the nose down.
    np.testing.assert_allclose(R[:, 0], [0, np.cos(0.1), -np.sin(0.1)], atol=1e-9)


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.tum", "", "without 8 finite numbers"),
        ("a.tum", "1 2 3\n", "without 8 finite numbers"),
        ("a.txt", "1 2 3 4 5 6 7 8\n1 2 3\n", "no pose"),
        ("a.txt", "1 2 3 4 0 0 0 0\n", "no rotation"),
        ("a.txt", "1 2 3 4 nan 0 0 1\n", "without 8 finite numbers"),
        ("a.txt", "hello\n", "no trajectory among a.txt"),
        ("a.pdf", "", "no trajectory among a.pdf"),
    ],
)
def test_what_is_no_trajectory_is_said(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidInput, match=words):
        truth(Settings(), log_of(tmp_path))
