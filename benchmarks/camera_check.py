"""Targetless check of cameras: how many turned ones it finds, and how often it cries wolf.

`python -m benchmarks.camera_check [--first 301] [--drives 14] [--seconds 60] [--turn-deg 0.5] [--turned-drives 0] [--store FOLDER] [--json -]`
makes simulated drives with three cameras, each in a town of its own and from another place of its route on, and maps them
as far as the odometry. Every camera of every drive is one session: it is checked once with the calibration that the log
has (off by 0.03 deg about each axis and 3 mm along each, standard deviations), and once with that calibration from before
the camera was turned about a random axis. With `--turned-drives` further drives are made whose cameras
were turned in the simulator before the images were taken.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.figures import published
from benchmarks.scores import Figure
from benchmarks.sequences import Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.cameras import Camera, CameraAgreement, Cameras, Images
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.camera_check import Settings, camera_check
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp, so3_log
from scanloom.stages.logs.mounting import as_matrix4
from scanloom.stages.simulate.cameras import true_cameras
from scanloom.stages.simulate.settings import Settings as World

CAMERAS, RATE_HZ, LAP_M = 3, 1.0, 1200.0
READ = (Images, Cameras, Deskewed, Labels, Odometry)


@dataclass(frozen=True)
class Checked:
    """One camera of a drive, and what it truly lacks."""

    drive: int
    turned: bool
    true_deg: NDArray[np.float64]
    found: CameraAgreement

    @property
    def error_deg(self) -> NDArray[np.float64]:
        return np.array(self.found.offset_deg) - self.true_deg


def main() -> None:
    options = _options()
    rows: list[Checked] = []
    for seed in range(options.first, options.first + options.drives):
        made = produced(_drive(seed, options.seconds, 0.0), READ, options.store)
        rows += _told(_checked(seed, made, options.seconds, 0.0, 0.0))
        rows += _told(_checked(seed, made, options.seconds, 0.0, options.turn_deg))
    before = options.first - options.turned_drives
    turned: list[Checked] = []
    for seed in range(before, options.first):
        made = produced(_drive(seed, options.seconds, options.turn_deg), READ, options.store)
        turned += _told(_checked(seed, made, options.seconds, options.turn_deg, 0.0))
    sets = {
        "untouched": [row for row in rows if not row.turned],
        "turned": [row for row in rows if row.turned],
        "turned_in_drive": turned,
    }
    published(
        [figure for name, some in sets.items() if some for figure in _figures(some, name)], options.json
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="not used: drives are made here")
    parser.add_argument(
        "--store", type=Path, default=Path("build/camera_check"), help="folder of what is made"
    )
    parser.add_argument("--first", type=int, default=301, help="seed of the first drive")
    parser.add_argument("--drives", type=int, default=14, help="drives, with three cameras each")
    parser.add_argument(
        "--turned-drives", type=int, default=0, help="drives with cameras turned in the world"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a drive, s")
    parser.add_argument("--turn-deg", type=float, default=0.5, help="how far a camera was turned, deg")
    parser.add_argument("--json", default="", help="file for the figures, - for standard output")
    return parser.parse_args()


def _world(seed: int, seconds: float, turned_deg: float) -> dict[str, Any]:
    start_m = float(np.random.default_rng([seed, 9]).uniform(0.0, LAP_M))
    return {
        "seed": seed, "town_seed": seed, "parking_seed": seed, "duration_s": seconds, "start_m": round(start_m),
        "standstill_s": 1.0, "cameras": CAMERAS, "camera_rate_hz": RATE_HZ, "camera_turned_deg": turned_deg,
    }  # fmt: skip


def _drive(seed: int, seconds: float, turned_deg: float) -> Drive:
    name = f"drive_{seed}"
    return Drive(name, name, _world(seed, seconds, turned_deg))


def _checked(
    seed: int, made: Result, seconds: float, turned_deg: float, since_deg: float
) -> Iterator[Checked]:
    """All cameras of a drive that were turned in the world by `turned_deg`, and by `since_deg` since they were calibrated."""
    cameras = made.parts(Cameras)[0].cameras
    truth = {c.name: c for c in true_cameras(World.model_validate(_world(seed, seconds, turned_deg))).cameras}
    given = [_before(camera, seed, k, since_deg) for k, camera in enumerate(cameras)]
    found = camera_check(
        Settings(), made.parts(Images), Cameras(cameras=tuple(given)), made.parts(Deskewed), made.parts(Labels),
        made.parts(Odometry)[0],
    )  # fmt: skip
    for camera, each in zip(given, found.cameras, strict=True):
        lacks = inverse(np.array(camera.T_lidar_camera)) @ np.array(truth[camera.name].T_lidar_camera)
        yield Checked(seed, turned_deg + since_deg > 0, np.degrees(so3_log(lacks[:3, :3])), each)


def _before(camera: Camera, seed: int, number: int, turned_deg: float) -> Camera:
    """A camera by its calibration from before it was turned."""
    axis = np.random.default_rng([seed, number, 3]).normal(size=3)
    turn = pose(so3_exp(np.radians(turned_deg) * axis / np.linalg.norm(axis)), np.zeros(3))
    T = as_matrix4(np.array(camera.T_lidar_camera) @ inverse(turn))
    return camera.model_copy(update={"T_lidar_camera": T})


def _told(rows: Iterator[Checked]) -> list[Checked]:
    """Said on the screen, as they come."""
    seen = list(rows)
    for row in seen:
        offset, std = np.round(row.found.offset_deg, 3), np.round(row.found.std_deg, 3)
        Console(stderr=True, width=160).print(
            f"{row.drive} {'turned' if row.turned else 'untouched':9} {row.found.camera:9} {row.found.verdict:8} offset {offset} "
            f"error {np.round(row.error_deg, 3)} std {std}"
        )
    return seen


def _figures(rows: list[Checked], name: str) -> Iterator[Figure]:
    where = f"{len(rows)} cameras of {len({row.drive for row in rows})} drives, {name.replace('_', ' ')}"
    yield Figure(f"camera_check.{name}.sessions", len(rows), "", "run", where)
    for verdict in ("moved", "agrees", "unknown"):
        share = float(np.mean([row.found.verdict == verdict for row in rows]))
        yield Figure(f"camera_check.{name}.{verdict}", share, "", "run", f"share that is said so; {where}")
    judged = [row for row in rows if row.found.verdict != "unknown"]
    if not judged:
        return
    error, std = (
        np.array([row.error_deg if of == "error" else row.found.std_deg for row in judged])
        for of in ("error", "std")
    )
    for axis, letter in enumerate("xyz"):
        yield Figure(
            f"camera_check.{name}.error_{letter}_deg", float(np.sqrt(np.mean(error[:, axis] ** 2))), "deg", "run",
            f"root mean square of the turn's error about {letter}; {where}",
        )  # fmt: skip
        yield Figure(
            f"camera_check.{name}.mean_{letter}_deg", float(error[:, axis].mean()), "deg", "run",
            f"mean of the turn's error about {letter}; {where}",
        )  # fmt: skip
    within = float(np.mean(np.abs(error) < 2.0 * std))
    yield Figure(
        f"camera_check.{name}.within_2_std",
        within,
        "",
        "run",
        f"errors below two stated standard deviations; {where}",
    )
    size = float(np.linalg.norm(error, axis=1).max())
    yield Figure(f"camera_check.{name}.error_max_deg", size, "deg", "run", f"largest error; {where}")


if __name__ == "__main__":
    main()
