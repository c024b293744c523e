"""KITTI folders: scans, beams, tracks and calibration, and what is said of folders with holes in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.geometry.sweep import CLOCKWISE, rings_by_wrap
from scanloom.stages.logs.kitti import GNSS, IMU, SCANS, open_kitti, read_velodyne
from scanloom.stages.logs.pointcloud import azimuth_times
from scanloom.stages.logs.records import CloudFile, GnssSample, ImuSample
from tests.stages.logs.kitti_folder import (
    DRIVE,
    log_of,
    odometry_sequence,
    oxts_line,
    raw_drive,
    stamp_lines,
    stored_scan,
)

FIRST_NS = 1_317_042_164_000_000_000


def codes(source: object) -> list[str]:
    return [problem.code for problem in source.problems if problem.severity != "info"]  # type: ignore[attr-defined]


def test_a_raw_drive_gives_scans_imu_and_gnss_in_order(tmp_path: Path) -> None:
    source = open_kitti(log_of(raw_drive(tmp_path)))
    assert source.format == "kitti raw"
    assert [(t.name, t.kind, t.count, t.period_ns) for t in source.topics] == [
        (SCANS, "cloud", 4, 100_000_000), (IMU, "imu", 4, 100_000_000), (GNSS, "gnss", 4, 100_000_000)
    ]  # fmt: skip
    assert codes(source) == []
    messages = list(source.messages({SCANS, IMU, GNSS}))
    stamps = [message.body.stamp_ns for message in messages]
    assert stamps == sorted(stamps)
    assert stamps[0] == FIRST_NS
    assert [m.topic for m in source.messages({IMU})] == [IMU] * 4
    imu = next(m.body for m in messages if isinstance(m.body, ImuSample))
    assert imu.accel_m_s2 == (0.1, 0.2, 9.8)
    assert imu.gyro_rad_s == (0.01, 0.02, 0.03)
    gnss = next(m.body for m in messages if isinstance(m.body, GnssSample))
    assert (gnss.latitude_deg, gnss.status, gnss.satellites) == (49.0, 2, 9)
    np.testing.assert_allclose(np.diag(np.reshape(gnss.covariance_m2, (3, 3))), [0.16, 0.16, 0.64])
    lidar = next(e for e in source.extrinsics if e.sensor == "lidar")
    np.testing.assert_allclose(np.array(lidar.T_base_sensor)[:3, 3], [0.81, -0.32, 0.80])


@pytest.mark.parametrize("depth", ["above", "date", "drive"])
def test_the_folder_may_be_given_at_any_level(tmp_path: Path, depth: str) -> None:
    date = raw_drive(tmp_path / "raw/2011_09_26")
    root = {"above": tmp_path / "raw", "date": date, "drive": date / DRIVE}[depth]
    source = open_kitti(log_of(root))
    assert len(list(source.messages({SCANS}))) == 4
    assert codes(source) == (["kitti.calibration"] if depth == "drive" else [])


def test_beams_follow_from_the_order_of_storage(tmp_path: Path) -> None:
    points, ring = stored_scan(columns=400)
    points.tofile(tmp_path / "a.bin")
    cloud = read_velodyne(tmp_path / "a.bin", 5)
    np.testing.assert_array_equal(cloud.ring, ring)
    np.testing.assert_array_equal(np.column_stack((cloud.x_m, cloud.y_m, cloud.z_m, cloud.intensity)), points)
    assert cloud.stamp_at == "middle"


def test_beams_are_counted_without_knowing_their_number() -> None:
    points, ring = stored_scan(columns=300, beams=32)
    x, y, z = np.ascontiguousarray(points[:, :3].T)
    np.testing.assert_array_equal(rings_by_wrap(x, y, z), ring)
    shuffled = np.random.default_rng(0).permutation(len(x))
    assert not rings_by_wrap(x[shuffled], y[shuffled], z[shuffled]).any()
    assert len(rings_by_wrap(x[:0], y[:0], z[:0])) == 0


def test_times_run_clockwise_from_the_rear_with_the_stamp_ahead(tmp_path: Path) -> None:
    points, _ = stored_scan()
    points.tofile(tmp_path / "a.bin")
    cloud = read_velodyne(tmp_path / "a.bin", 0)
    assert cloud.sweep is not None
    assert cloud.sweep.direction == CLOCKWISE
    share = azimuth_times(cloud, 100_000_000) / 100_000_000
    np.testing.assert_allclose(
        share, 0.5 - np.arctan2(points[:, 1].astype(float), points[:, 0]) / (2 * np.pi), atol=1e-5
    )


def test_timestamps_of_oxts_stand_in(tmp_path: Path) -> None:
    raw_drive(tmp_path)
    (tmp_path / DRIVE / "velodyne_points/timestamps.txt").unlink()
    source = open_kitti(log_of(tmp_path))
    assert next(iter(source.messages({SCANS}))).body.stamp_ns == FIRST_NS
    assert any("oxts/timestamps.txt" in p.text for p in source.problems)
    (tmp_path / DRIVE / "oxts/timestamps.txt").unlink()
    source = open_kitti(log_of(tmp_path))
    assert [m.body.stamp_ns for m in source.messages({SCANS, IMU})] == [
        0,
        100_000_000,
        200_000_000,
        300_000_000,
    ]
    assert codes(source).count("kitti.oxts_no_time") == 1


def test_missing_cut_and_empty_scans_are_named(tmp_path: Path) -> None:
    raw_drive(tmp_path, 8)
    data = tmp_path / DRIVE / "velodyne_points/data"
    (data / "0000000002.bin").unlink()
    (data / "0000000003.bin").unlink()
    (data / "0000000005.bin").write_bytes((data / "0000000005.bin").read_bytes()[:1607])
    (data / "0000000006.bin").write_bytes(b"")
    (data / "readme.md").write_text("not a scan")
    source = open_kitti(log_of(tmp_path))
    assert codes(source) == ["kitti.scans_missing", "kitti.scan_cut", "kitti.scan_empty"]
    texts = " | ".join(problem.text for problem in source.problems)
    assert "2 of 8 scans are missing: 2 to 3" in texts
    assert "7 bytes left out, 100 points kept" in texts
    clouds = [m.body.load() for m in source.messages({SCANS}) if isinstance(m.body, CloudFile)]
    assert len(clouds) == 5
    assert sorted(len(cloud.x_m) for cloud in clouds)[0] == 100


def test_fewer_timestamps_than_scans(tmp_path: Path) -> None:
    raw_drive(tmp_path, 5)
    (tmp_path / DRIVE / "velodyne_points/timestamps.txt").write_text(stamp_lines(3) + "no time at all\n")
    source = open_kitti(log_of(tmp_path))
    assert codes(source) == ["kitti.timestamps_broken", "kitti.scans_without_time"]
    assert len(list(source.messages({SCANS}))) == 3


def test_broken_oxts_records_are_left_out(tmp_path: Path) -> None:
    raw_drive(tmp_path)
    oxts = tmp_path / DRIVE / "oxts/data"
    (oxts / "0000000001.txt").write_text("49.0 8.4")
    (oxts / "0000000002.txt").write_text("garbage")
    source = open_kitti(log_of(tmp_path))
    assert codes(source) == ["kitti.oxts_broken"]
    assert len(list(source.messages({IMU}))) == 2


@pytest.mark.parametrize("mode, status", [(4, 2), (5, 2), (6, 2), (7, 1), (3, 0), (2, -1), (0, -1), (-1, 0)])
def test_receiver_modes_become_fix_status(tmp_path: Path, mode: int, status: int) -> None:
    raw_drive(tmp_path, 1)
    (tmp_path / DRIVE / "oxts/data/0000000000.txt").write_text(oxts_line(0, mode=mode))
    (message,) = open_kitti(log_of(tmp_path)).messages({GNSS})
    assert isinstance(message.body, GnssSample)
    assert message.body.status == status


def test_several_drives_are_said(tmp_path: Path) -> None:
    raw_drive(tmp_path, 2)
    other = tmp_path / "2011_09_26_drive_0009_sync/velodyne_points/data"
    other.mkdir(parents=True)
    stored_scan(columns=30)[0].tofile(other / "0000000000.bin")
    source = open_kitti(log_of(tmp_path))
    assert codes(source) == ["kitti.several_drives"]
    assert len(list(source.messages({SCANS}))) == 2


def test_an_odometry_sequence_is_compensated_already(tmp_path: Path) -> None:
    source = open_kitti(log_of(odometry_sequence(tmp_path)))
    assert source.format == "kitti odometry"
    bodies = [m.body for m in source.messages({SCANS})]
    assert [b.stamp_ns for b in bodies] == [0, 103_600_000, 207_200_000]
    assert isinstance(bodies[0], CloudFile)
    assert bodies[0].load().compensated


def test_an_odometry_sequence_without_times_runs_at_10_hz(tmp_path: Path) -> None:
    odometry_sequence(tmp_path)
    (tmp_path / "times.txt").unlink()
    source = open_kitti(log_of(tmp_path))
    assert codes(source) == ["kitti.timestamps_missing"]
    assert [m.body.stamp_ns for m in source.messages({SCANS})] == [0, 100_000_000, 200_000_000]


def test_folders_without_usable_scans_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InvalidInput, match="no scans"):
        open_kitti(log_of(tmp_path))
    raw_drive(tmp_path / "date", 2)
    for path in (tmp_path / "date" / DRIVE / "velodyne_points/data").iterdir():
        path.write_bytes(b"short")
    with pytest.raises(InvalidInput, match="none of 2 scans"):
        open_kitti(log_of(tmp_path / "date"))
