"""TUM and KITTI, read by numpy, and by evo where it is installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.trajectory import seconds, write_kitti, write_tum
from tests.stages.exports.tracks import MUNICH, START_NS, delivered, poses_along, way


def two_sessions(origin: Georeference | None = MUNICH) -> dict[str, Poses]:
    return {
        "a": poses_along(way(30), origin),
        "b": poses_along(way(7, turn=2.0), origin, start_ns=START_NS + 10**12, yaw_rad=-3.0),
    }


def test_evo_reads_tum(tmp_path: Path) -> None:
    sessions = two_sessions()
    written = write_tum(delivered(tmp_path / "m", MUNICH, sessions), tmp_path, Options())
    assert [path.name for path in written] == ["a.tum", "b.tum"]
    files = pytest.importorskip("evo.tools.file_interface")
    for path, poses in zip(written, sessions.values(), strict=True):
        read = files.read_tum_trajectory_file(path)
        np.testing.assert_allclose(read.timestamps, poses.stamp_ns * 1e-9, rtol=0.0, atol=3e-7)
        np.testing.assert_allclose(np.array(read.poses_se3), poses.T_world_lidar, rtol=0.0, atol=1e-6)


def test_evo_reads_kitti(tmp_path: Path) -> None:
    sessions = two_sessions()
    written = write_kitti(delivered(tmp_path / "m", MUNICH, sessions), tmp_path, Options())
    assert [path.name for path in written] == ["a.txt", "a_times.txt", "b.txt", "b_times.txt", "README.txt"]
    files = pytest.importorskip("evo.tools.file_interface")
    for name, poses in sessions.items():
        read = files.read_kitti_poses_file(tmp_path / f"{name}.txt")
        np.testing.assert_allclose(np.array(read.poses_se3), poses.T_world_lidar, rtol=0.0, atol=1e-8)


def test_numbers_of_tum_and_kitti(tmp_path: Path) -> None:
    sessions = two_sessions()
    source = delivered(tmp_path / "m", MUNICH, sessions)
    write_tum(source, tmp_path, Options())
    write_kitti(source, tmp_path, Options())
    for name, poses in sessions.items():
        stamps = [seconds(s) for s in poses.stamp_ns]
        rows = [line.split() for line in (tmp_path / f"{name}.tum").read_text().splitlines()]
        assert [row[0] for row in rows] == stamps
        x, y, z, w = np.array([row[4:] for row in rows], float).T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        R = poses.T_world_lidar[:, :3, :3]
        np.testing.assert_allclose(yaw, np.arctan2(R[:, 1, 0], R[:, 0, 0]), rtol=0.0, atol=1e-8)
        matrices = np.loadtxt(tmp_path / f"{name}.txt").reshape(-1, 3, 4)
        np.testing.assert_allclose(matrices, poses.T_world_lidar[:, :3], rtol=0.0, atol=1e-8)
        assert (tmp_path / f"{name}_times.txt").read_text().split() == stamps
    note = (tmp_path / "README.txt").read_text()
    assert "LiDAR" in note and "48.130000000" in note


def test_a_map_without_georeference_keeps_its_own_frame(tmp_path: Path) -> None:
    source = delivered(tmp_path / "m", None, {"a": poses_along(way(3), None)})
    write_kitti(source, tmp_path, Options())
    assert "not georeferenced" in (tmp_path / "README.txt").read_text()
    assert len(write_tum(source, tmp_path, Options())[0].read_text().splitlines()) == 3


@pytest.mark.parametrize("scans", [0, 1])
def test_short_sessions(tmp_path: Path, scans: int) -> None:
    source = delivered(tmp_path / "m", MUNICH, {"a": poses_along(way(scans), MUNICH)})
    assert len(write_tum(source, tmp_path, Options())[0].read_text().splitlines()) == scans
    assert len(write_kitti(source, tmp_path, Options())[0].read_text().splitlines()) == scans


def test_stamps_keep_nanoseconds() -> None:
    assert seconds(1_760_000_000_049_951_173) == "1760000000.049951173"
    assert seconds(5) == "0.000000005"
    assert seconds(0) == "0.000000000"
