"""Small KITTI folders in their own layout, written from scratch."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scanloom.schemas.session import RawLog

DRIVE = "2011_09_26_drive_0005_sync"
PERIOD_S = 0.1
BEAMS = 64


def stored_scan(seed: int = 0, *, columns: int = 360, beams: int = BEAMS) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 4) as KITTI stores them, beam after beam from the top, each by rising azimuth; and their ring (n,)."""
    rng = np.random.default_rng(seed)
    points, rings = [], []
    for ring, elevation in reversed(list(enumerate(np.radians(np.linspace(-24, 2, beams))))):
        # The lowest beams see the car itself ahead and behind, and have holes there.
        azimuth = np.sort(rng.uniform(0, 2 * np.pi, columns))
        if ring < 5:
            azimuth = azimuth[(azimuth > 0.35) & (azimuth < 5.9)]
        r = rng.uniform(4, 50, len(azimuth))
        flat = r * np.cos(elevation)
        points.append(
            np.column_stack(
                (
                    flat * np.cos(azimuth),
                    flat * np.sin(azimuth),
                    r * np.sin(elevation),
                    rng.random(len(azimuth)),
                )
            )
        )
        rings.append(np.full(len(azimuth), ring))
    return np.concatenate(points).astype("<f4"), np.concatenate(rings)


def oxts_line(i: int, *, speed: float = 10.0, mode: int = 4) -> str:
    """A record of a car that drives east along a parallel at constant speed."""
    metres_per_degree = 6378137.0 * np.pi / 180 * np.cos(np.radians(49.0))
    row = np.zeros(30)
    row[:6] = 49.0, 8.4 + i * PERIOD_S * speed / metres_per_degree, 112.0, 0.01, -0.02, 0.0
    row[8] = speed
    row[11:14] = 0.1, 0.2, 9.8
    row[17:20] = 0.01, 0.02, 0.03
    row[23], row[24] = 0.4, 0.05
    row[25:30] = 4, 9, mode, 4, 0
    return " ".join(f"{value:.12g}" for value in row)


def stamp_lines(count: int) -> str:
    return "".join(f"2011-09-26 13:02:{44 + i // 10:02d}.{i % 10}00000000\n" for i in range(count))


def raw_drive(root: Path, count: int = 4) -> Path:
    """A date folder with one drive of `count` scans."""
    drive = root / DRIVE
    (drive / "velodyne_points/data").mkdir(parents=True)
    (drive / "oxts/data").mkdir(parents=True)
    for i in range(count):
        stored_scan(i, columns=60)[0].tofile(drive / f"velodyne_points/data/{i:010d}.bin")
        (drive / f"oxts/data/{i:010d}.txt").write_text(oxts_line(i) + "\n")
    (drive / "velodyne_points/timestamps.txt").write_text(stamp_lines(count))
    (drive / "oxts/timestamps.txt").write_text(stamp_lines(count))
    (root / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.80\n")
    return root


def odometry_sequence(root: Path, count: int = 3) -> Path:
    """A sequence folder with `count` scans, its times and calibration."""
    (root / "velodyne").mkdir(parents=True)
    for i in range(count):
        stored_scan(i, columns=60)[0].tofile(root / f"velodyne/{i:06d}.bin")
    (root / "times.txt").write_text("".join(f"{i * 0.1036:e}\n" for i in range(count)))
    (root / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n")
    return root


def log_of(root: Path) -> RawLog:
    return RawLog(root=root, names=names_of(root))


def names_of(root: Path) -> tuple[str, ...]:
    return tuple(sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file()))
