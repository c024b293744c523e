"""TUM and KITTI, read by evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.trajectory import seconds, write_kitti, write_tum
from tests.stages.exports.tracks import MUNICH, START_NS, delivered, poses_along, way

files = pytest.importorskip("evo.tools.file_interface")


def two_sessions(folder: Path, origin: object = MUNICH) -> dict[str, Poses]:
    return {
        "a": poses_along(way(30), origin),  # type: ignore[arg-type]
        "b": poses_along(way(7, turn=2.0), origin, start_ns=START_NS + 10**12, yaw_rad=-3.0),  # type: ignore[arg-type]
    }


def test_evo_reads_tum(tmp_path: Path) -> None:
    sessions = two_sessions(tmp_path)
    written = write_tum(delivered(tmp_path / "m", MUNICH, sessions), tmp_path, Options())
    assert [path.name for path in written] == ["a.tum", "b.tum"]
    for path, poses in zip(written, sessions.values(), strict=True):
        read = files.read_tum_trajectory_file(path)
        np.testing.assert_allclose(read.timestamps, poses.stamp_ns * 1e-9, rtol=0.0, atol=3e-7)
        np.testing.assert_allclose(np.array(read.poses_se3), poses.T_world_lidar, rtol=0.0, atol=1e-6)
        stamps = [line.split()[0] for line in path.read_text().splitlines()]
        assert stamps == [seconds(s) for s in poses.stamp_ns]


def test_evo_reads_kitti(tmp_path: Path) -> None:
    sessions = two_sessions(tmp_path)
    written = write_kitti(delivered(tmp_path / "m", MUNICH, sessions), tmp_path, Options())
    assert [path.name for path in written] == ["a.txt", "a_times.txt", "b.txt", "b_times.txt", "README.txt"]
    for name, poses in sessions.items():
        read = files.read_kitti_poses_file(tmp_path / f"{name}.txt")
        np.testing.assert_allclose(np.array(read.poses_se3), poses.T_world_lidar, rtol=0.0, atol=1e-8)
        times = (tmp_path / f"{name}_times.txt").read_text().split()
        assert times == [seconds(s) for s in poses.stamp_ns]
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
