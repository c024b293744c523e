"""Small logs on disk for tests of the whole way through."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.worlds import drive, street


def scan_folder(folder: Path, count: int = 14, *, seed: int = 0, step_m: float = 0.8) -> Path:
    """A plain folder of KITTI-style `.bin` scans along a simulated street; no IMU, no GNSS, no times."""
    folder.mkdir(parents=True)
    scans, _ = drive(street(seed, length_m=40), count, step_m=step_m, yaw_step_rad=0.01, seed=seed)
    for i, scan in enumerate(scans):
        np.column_stack((scan.points(), scan.intensity)).astype("<f4").tofile(folder / f"{i:06d}.bin")
    return folder
