"""What is odd about a log is said; what is not odd is not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.stages.logs.checks import gnss_problems, imu_problems, stamp_problems
from scanloom.stages.logs.inspection import inspect_log
from scanloom.stages.logs.mounting import TfTree, resolve
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.records import Transform, Transforms
from tests.stages.logs.writing import ROS2, drive, write_mcap

START_NS = 1_700_000_000_000_000_000


def stamps(count: int = 200, rate_hz: float = 100.0) -> np.ndarray:
    return START_NS + (np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def codes(header: np.ndarray, receive: np.ndarray | None = None, role: str = "imu") -> dict[str, str]:
    found = stamp_problems(role, "/imu", header, header if receive is None else receive, START_NS)
    return {problem.code: problem.text for problem in found}


def test_a_sound_track_has_no_problem() -> None:
    rng = np.random.default_rng(0)
    header = stamps() + rng.normal(0, 2e5, 200).astype(np.int64)
    assert codes(header, header + rng.integers(1_000_000, 30_000_000, 200)) == {}


def test_gaps() -> None:
    header = np.delete(stamps(), np.s_[50:120])
    assert "longest lasts 0.71 s, at 0.5 s" in codes(header)["imu.gap"]
    assert "35 %" in codes(header)["imu.gap"]


def test_backwards_and_duplicate_stamps() -> None:
    header = stamps()
    header[[10, 11]] = header[[11, 10]]
    header[100] = header[99]
    found = codes(header)
    assert "backwards once" in found["imu.backwards"]
    assert "1 message with the stamp of the one before" in found["imu.duplicate"]


def test_clock_jump_is_told_from_a_late_message() -> None:
    header = stamps()
    jumped = header.copy()
    jumped[100:] += 2_000_000_000
    assert "jumps once, first by +2 s at 1.0 s" in codes(jumped, header)["imu.clock_jump"]
    late = header.copy()
    late[100] += 2_000_000_000
    assert "imu.clock_jump" not in codes(header, late)


def test_another_clock() -> None:
    assert "55 days behind" in codes(stamps() - 55 * 86_400_000_000_000, stamps())["imu.clock"]
    assert "imu.clock" not in codes(stamps(), stamps() + 500_000_000)


@pytest.mark.parametrize(
    ("role", "rate_hz", "odd"),
    [
        ("imu", 100, False),
        ("imu", 10, True),
        ("lidar", 10, False),
        ("lidar", 1, True),
        ("gnss", 1, False),
        ("lidar", 100, True),
    ],
)
def test_rates(role: str, rate_hz: float, odd: bool) -> None:
    assert (f"{role}.rate" in codes(stamps(50, rate_hz), role=role)) == odd


def imu(accel: tuple[float, float, float] = (0.0, 0.0, 9.81), gyro: float = 0.1) -> Imu:
    rng = np.random.default_rng(0)
    return Imu(
        stamp_ns=stamps(),
        gyro_rad_s=rng.normal(0, gyro, (200, 3)),
        accel_m_s2=np.array(accel) + rng.normal(0, 0.1, (200, 3)),
    )


ROLL_90 = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.mark.parametrize(
    ("table", "rotation", "expected"),
    [
        (imu(), np.eye(3), set()),
        (imu((0, 9.81, 0)), np.eye(3), {"imu.gravity_axis"}),
        (imu((0, 9.81, 0)), ROLL_90, set()),
        (imu((0, 0, -9.81)), np.eye(3), {"imu.gravity_axis"}),
        (imu((0, 0, 0.0)), np.eye(3), {"imu.gravity"}),
        (imu(gyro=20.0), np.eye(3), {"imu.gyro_unit"}),
        (Imu.empty(), np.eye(3), set()),
    ],
)
def test_imu(table: Imu, rotation: np.ndarray, expected: set[str]) -> None:
    assert {p.code for p in imu_problems(table, "/imu", rotation, True)} == expected


def gnss(**changes: Any) -> Gnss:
    columns: dict[str, Any] = {
        "stamp_ns": stamps(100, 5.0),
        "latitude_deg": np.full(100, 48.0),
        "longitude_deg": np.full(100, 9.0),
        "height_m": np.full(100, 300.0),
        "covariance_m2": np.tile(np.eye(3), (100, 1, 1)),
        "status": np.zeros(100, np.int8),
        "satellites": np.full(100, -1, np.int16),
    }
    return Gnss(**(columns | changes))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, set()),
        ({"status": np.full(100, -1, np.int8)}, {"gnss.no_fix"}),
        ({"latitude_deg": np.full(100, np.nan)}, {"gnss.no_fix"}),
        ({"status": np.repeat(np.array([0, -1], np.int8), 50)}, {"gnss.outage"}),
        ({"covariance_m2": np.zeros((100, 3, 3))}, {"gnss.covariance"}),
    ],
)
def test_gnss(changes: dict[str, Any], expected: set[str]) -> None:
    assert {p.code for p in gnss_problems(gnss(**changes), "/fix")} == expected


def edge(parent: str, child: str, x: float = 0.0) -> Transform:
    T = np.eye(4)
    T[0, 3] = x
    return Transform(START_NS, parent, child, T)


def test_mounting_follows_the_rigid_part_of_the_tree() -> None:
    tree = TfTree()
    tree.note(
        Transforms(START_NS, START_NS, (edge("base_link", "mast", 1.0), edge("mast", "lidar", 2.0)), True)
    )
    tree.note(Transforms(START_NS, START_NS, (edge("imu", "mast", 4.0),), True))
    for step in range(3):
        tree.note(
            Transforms(
                START_NS, START_NS, (edge("odom", "base_link", step), edge("mast", "gnss", step)), False
            )
        )
    frames = {"lidar": "lidar", "imu": "imu", "gnss": "gnss"}
    extrinsics, problems = resolve(tree, frames, {}, ())
    found = {e.sensor: (e.T_base_sensor[0][3], e.source) for e in extrinsics}
    assert found == {"lidar": (3.0, "tf"), "imu": (-3.0, "tf"), "gnss": (0.0, "assumed identity")}
    assert [p.code for p in problems] == ["extrinsics.assumed"]
    assert "gnss (frame gnss)" in problems[0].text


def test_a_tree_with_a_loop_ends() -> None:
    tree = TfTree()
    tree.note(Transforms(START_NS, START_NS, (edge("a", "lidar"), edge("lidar", "a")), True))
    extrinsics, _ = resolve(tree, {"lidar": "lidar"}, {}, ())
    assert extrinsics[0].sensor == "lidar"


def test_inspection_of_a_sound_log(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2, scans=20))
    found = inspect_log(path)
    assert found.usable
    assert found.used == {"lidar": "/points", "imu": "/imu", "gnss": "/fix", "wheel": "/odom"}
    assert (found.scans, found.points_per_scan, found.beams) == (20, 382, 4)
    assert 1.9 < found.duration_s < 2.1
    assert found.missing == ()
    assert found.next_step == f"scanloom map {path}"
    assert json.loads(json.dumps(found.as_json()))["topics"][0]["name"] == "/fix"


def test_inspection_says_what_is_lost(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2, scans=20))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = inspect_log(path)
    assert found.usable
    assert not found.complete
    assert found.next_step.startswith("Copy the log again")


def test_inspection_uses_the_session_file(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", drive(ROS2))
    (tmp_path / "session.yaml").write_text("log: a.mcap\ntopics: {imu: none, wheel: none}\n")
    found = inspect_log(tmp_path, Settings(gnss_topic="none"))
    assert found.used == {"lidar": "/points"}
    assert len(found.missing) == 3


def test_inspection_of_no_log(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_text("text")
    with pytest.raises(InvalidInput):
        inspect_log(tmp_path / "a.bag")


@pytest.mark.parametrize(
    ("name", "usable", "expected"),
    [
        ("ouster_0.2s_ros1names.mcap", True, {"imu.clock_shifted", "lidar.clock", "imu.clock"}),
        ("husky_imu_wheel_gnss.bag", False, {"log.unusable", "imu.gravity_axis", "imu.rate"}),
        ("tilt_laser_imu_gnss.bag", False, {"log.unusable", "imu.clock_jump", "wheel.duplicate"}),
    ],
)
def test_real_logs_are_explained(shared_data: Path, name: str, usable: bool, expected: set[str]) -> None:
    found = inspect_log(shared_data / "bags" / name)
    assert found.usable == usable
    assert expected <= {problem.code for problem in found.problems}
    assert usable == found.next_step.startswith("scanloom map")


def test_a_wrong_setting_in_a_session_file_is_named(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", drive(ROS2))
    (tmp_path / "session.yaml").write_text("log: a.mcap\nsettings: {ingest: {chunk_sec: 3}}\n")
    with pytest.raises(UsageError, match=r"ingest\.chunk_sec.*did you mean ingest\.chunk_s"):
        inspect_log(tmp_path)
