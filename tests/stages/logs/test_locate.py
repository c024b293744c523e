"""What a path given by the user is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.logs.locate import locate
from tests.stages.logs.writing import ROS1, ROS2, drive, write_mcap, write_rosbag1, write_rosbag2


def scan_file(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.ones((10, 4), np.float32).tofile(path)
    return path


def kitti_raw(root: Path) -> Path:
    date = root / "2011_09_26"
    drive_folder = date / "2011_09_26_drive_0005_sync"
    for i in range(3):
        scan_file(drive_folder / f"velodyne_points/data/{i:010d}.bin")
        oxts = drive_folder / f"oxts/data/{i:010d}.txt"
        oxts.parent.mkdir(parents=True, exist_ok=True)
        oxts.write_text(" ".join(["0"] * 30))
    (date / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
    return drive_folder


@pytest.mark.parametrize("level", [0, 1, 2])
def test_kitti_raw_from_any_of_its_folders(tmp_path: Path, level: int) -> None:
    drive_folder = kitti_raw(tmp_path)
    log = locate([drive_folder, drive_folder.parent, tmp_path][level])
    assert log.format == "kitti raw"
    assert log.name == "2011_09_26_drive_0005_sync"
    assert "calib_imu_to_velo.txt" in log.raw_log.names
    assert sum(name.endswith(".bin") for name in log.raw_log.names) == 3
    assert all("oxts" in name or name == "calib_imu_to_velo.txt" for name in log.truth_log.names)
    assert len(log.truth_log.names) == 4
    assert all(log.raw_log.path(name).is_file() for name in log.raw_log.names)


def test_two_drives_are_ambiguous(tmp_path: Path) -> None:
    other = kitti_raw(tmp_path).parent / "2011_09_26_drive_0009_sync/velodyne_points/data/0000000000.bin"
    scan_file(other)
    with pytest.raises(InvalidInput, match=r"2 drives.*drive_0005.*drive_0009.*give one of them"):
        locate(tmp_path)


def test_kitti_odometry_with_its_poses(tmp_path: Path) -> None:
    sequence = tmp_path / "sequences/07"
    for i in range(3):
        scan_file(sequence / f"velodyne/{i:06d}.bin")
    for name in ("times.txt", "calib.txt"):
        (sequence / name).write_text("0\n1\n2\n")
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses/07.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    log = locate(sequence)
    assert log.format == "kitti odometry"
    assert set(log.raw_log.names) == {
        "velodyne/000000.bin",
        "velodyne/000001.bin",
        "velodyne/000002.bin",
        "times.txt",
        "calib.txt",
    }
    assert "poses/07.txt" in log.truth_log.names


def test_bags(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path / "one.bag", drive(ROS1))
    mcap = write_mcap(tmp_path / "drive.07.mcap", drive(ROS2))
    folder = write_rosbag2(tmp_path / "bag", drive(ROS2), "sqlite")
    assert (locate(bag).format, locate(bag).name) == ("rosbag1", "one")
    assert (locate(mcap).format, locate(mcap).name) == ("mcap", "drive.07")
    assert (locate(folder).format, locate(folder).name) == ("rosbag2", "bag")
    assert locate(folder / "metadata.yaml").raw_log == locate(folder).raw_log
    with pytest.raises(InvalidInput, match=r"several formats.*give one of these files"):
        locate(tmp_path)


def test_truth_beside_a_sample_is_truth_and_never_log(tmp_path: Path) -> None:
    write_rosbag2(tmp_path / "sample", drive(ROS2), "mcap")
    truth = tmp_path / "sample/truth"
    truth.mkdir()
    (truth / "trajectory.parquet").write_bytes(b"x")
    log = locate(tmp_path / "sample")
    assert log.truth_log.names == ("trajectory.parquet",)
    assert not any("truth" in name or "parquet" in name for name in log.raw_log.names)
    nested = tmp_path / "outer"
    nested.mkdir()
    os.rename(tmp_path / "sample", nested / "log")
    os.rename(nested / "log/truth", nested / "truth")
    log = locate(nested)
    assert log.truth_log.names == ("trajectory.parquet",)
    assert log.name == "outer"


def test_scans(tmp_path: Path) -> None:
    for i in range(3):
        scan_file(tmp_path / f"{i}.bin")
    assert locate(tmp_path).format == "point files"
    (tmp_path / "a.pcd").write_text("x")
    with pytest.raises(InvalidInput, match="several formats"):
        locate(tmp_path)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: p / "nothing.bag", "no such file or folder"),
        (lambda p: _file(p / "empty.bag", b""), "The file is empty"),
        (
            lambda p: _file(p / "text.bag", b"Dear user, this is text.\n" * 20),
            "named .bag but holds plain text",
        ),
        (lambda p: _file(p / "zeros.mcap", bytes(5000)), "nothing but zeros"),
        (lambda p: _file(p / "photo.jpg", os.urandom(100)), "This is no log"),
        (lambda p: _file(p / "really.bag", b"\x89MCAP0\r\n" + bytes(100)), "holds a .mcap file; rename it"),
        (lambda p: p, "folder holds no log"),
        (lambda p: scan_file(p / "one.bin"), "a single scan; a map needs several"),
    ],
)
def test_what_is_no_log_is_refused_in_words(tmp_path: Path, make: object, sentence: str) -> None:
    path = make(tmp_path)  # type: ignore[operator]
    with pytest.raises(InvalidInput, match=sentence) as caught:
        locate(path)
    assert caught.value.next_step
    assert str(path) in str(caught.value)


def _file(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_session_file(tmp_path: Path) -> None:
    write_mcap(tmp_path / "drive.mcap", drive(ROS2))
    (tmp_path / "truth.tum").write_text("1 0 0 0 0 0 0 1\n")
    (tmp_path / "session.yaml").write_text(
        "log: drive.mcap\nname: seven\ntopics: {lidar: /points, imu: none}\n"
        "extrinsics: {lidar: [1, 2, 3, 0, 0, 0]}\ntruth: {file: truth.tum, poses_of: camera}\n"
        "settings: {odometry: {voxel_size_m: 0.4}, ingest: {chunk_s: 5}}\n"
    )
    for path in (tmp_path / "session.yaml", tmp_path):
        log = locate(path)
        assert log.name == "seven"
        assert log.raw_log.names == ("drive.mcap",)
        assert log.truth_log.names == ("truth.tum",)
        assert log.settings == {
            "ingest": {
                "lidar_topic": "/points",
                "imu_topic": "none",
                "lidar_on_base": [1, 2, 3, 0, 0, 0],
                "chunk_s": 5,
            },
            "truth": {"poses_of": "camera"},
            "odometry": {"voxel_size_m": 0.4},
        }


def test_session_file_with_several_bags(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    write_rosbag1(tmp_path / "a/1.bag", drive(ROS1))
    write_rosbag1(tmp_path / "b/2.bag", drive(ROS1))
    (tmp_path / "two.yaml").write_text("log: [a/1.bag, b/2.bag]\n")
    log = locate(tmp_path / "two.yaml")
    assert log.name == "two"
    assert log.raw_log.names == ("a/1.bag", "b/2.bag")


@pytest.mark.parametrize(
    ("text", "error", "sentence"),
    [
        ("log: drive.mcap\ntopisc: {}\n", UsageError, "unknown key: topisc.*did you mean topics"),
        ("log: drive.mcap\ntopics: {ldiar: /a}\n", UsageError, r"topics\.ldiar.*did you mean lidar"),
        ("log: drive.mcap\ntopics: [1]\n", UsageError, "topics"),
        ("log: other.mcap\n", InvalidInput, "no such file"),
        ("log: .\n", InvalidInput, "names itself"),
        ("log: drive.mcap\ntruth: nowhere.tum\n", InvalidInput, "no such file with truth"),
        ("name: a\n", InvalidInput, "names no log"),
        ("log: [unclosed\n", InvalidInput, "cannot be read"),
        ("- 1\n", InvalidInput, "names no log"),
    ],
)
def test_session_files_that_are_wrong(
    tmp_path: Path, text: str, error: type[Exception], sentence: str
) -> None:
    write_mcap(tmp_path / "drive.mcap", drive(ROS2))
    (tmp_path / "session.yaml").write_text(text)
    with pytest.raises(error, match=sentence):
        locate(tmp_path / "session.yaml")
