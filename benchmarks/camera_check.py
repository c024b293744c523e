"""Targetless check of cameras: how many turned ones it finds, and how often it cries wolf.

`python -m benchmarks.camera_check [--first 0] [--sessions 12] [--likeness 0.6] [--turn-deg 0.5] [--json -]` drives through
streets of boxes, each another one, whose reflectance follows the grey of the images as far as `--likeness` says. Every session is checked
once as it is and once with a camera that was turned about a random axis. Calibration errors of 2 mm and 0.03 deg and a
clock error of 2 ms are added to both.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.figures import published
from benchmarks.scores import Figure
from scanloom.schemas.cameras import Camera, CameraAgreement, Cameras
from scanloom.stages.camera_check import Settings, camera_check
from scanloom.stages.geometry.se3 import pose, so3_exp
from scanloom.stages.logs.mounting import as_matrix4
from tests.stages.camera_check.street import Recorded, Street, mounted, record

SCATTER_M, SCATTER_DEG = 0.002, 0.03


def main() -> None:
    options = _options()
    rows = []
    for seed in range(options.first, options.first + options.sessions):
        recorded = record(Street(seed, options.likeness), options.images)
        axis = np.random.default_rng([seed, 3]).normal(size=3)
        turn = options.turn_deg * axis / np.linalg.norm(axis)
        rows.append((turn, _checked(recorded, np.zeros(3), seed), _checked(recorded, turn, seed)))
    published(list(_figures(rows, options)), options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="not used: streets are made here")
    parser.add_argument("--first", type=int, default=0, help="number of the first session")
    parser.add_argument("--sessions", type=int, default=12, help="sessions")
    parser.add_argument("--images", type=int, default=24, help="images of a session")
    parser.add_argument(
        "--likeness", type=float, default=0.6, help="1: reflectance follows grey, 0: it does not"
    )
    parser.add_argument("--turn-deg", type=float, default=0.5, help="how far the camera was turned, deg")
    parser.add_argument("--json", help="file for the figures, - for standard output")
    return parser.parse_args()


def _checked(recorded: Recorded, turn_deg: np.ndarray, seed: int) -> CameraAgreement:
    """What the check says of a camera that was turned after its calibration, which was not perfect either."""
    rng = np.random.default_rng([seed, 4])
    error = pose(so3_exp(np.radians(rng.normal(0, SCATTER_DEG, 3))), rng.normal(0, SCATTER_M, 3))
    camera = mounted(tuple(turn_deg.tolist()))
    T = as_matrix4(np.array(camera.T_lidar_camera) @ error)
    given = Cameras(cameras=(Camera(name=camera.name, model=camera.model, T_lidar_camera=T),))
    found = camera_check(
        Settings(), recorded.images, given, recorded.deskewed, recorded.labels, recorded.odometry
    )
    return found.cameras[0]


def _figures(
    rows: list[tuple[np.ndarray, CameraAgreement, CameraAgreement]], options: argparse.Namespace
) -> Iterator[Figure]:
    where = f"{len(rows)} streets, likeness {options.likeness:g}, {options.images} images"
    for name, count, method in (
        ("turned_found", sum(t.verdict == "moved" for _, _, t in rows), f"said to have moved, of those turned by {options.turn_deg:g} deg"),
        ("turned_agrees", sum(t.verdict == "agrees" for _, _, t in rows), "said to agree, of those turned"),
        ("untouched_moved", sum(u.verdict == "moved" for _, u, _ in rows), "said to have moved, of those untouched"),
        ("untouched_agrees", sum(u.verdict == "agrees" for _, u, _ in rows), "said to agree, of those untouched"),
    ):  # fmt: skip
        yield Figure(f"camera_check.{name}", count / len(rows), "", "run", f"{method}; {where}")
    errors = [np.array(u.offset_deg) for _, u, _ in rows] + [
        np.array(t.offset_deg) - turn for turn, _, t in rows
    ]
    stds = [np.array(each.std_deg) for _, u, t in rows for each in (u, t)]
    size = np.linalg.norm(errors, axis=1)
    for axis, name in enumerate("xyz"):
        rms = float(np.sqrt(np.mean(np.square(errors)[:, axis])))
        yield Figure(
            f"camera_check.error_{name}_deg",
            rms,
            "deg",
            "run",
            f"root mean square of the turn's error; {where}",
        )
        told = float(np.median(np.array(stds)[:, axis]))
        yield Figure(
            f"camera_check.std_{name}_deg",
            told,
            "deg",
            "run",
            f"median of the stated standard deviation; {where}",
        )
    yield Figure(
        "camera_check.error_max_deg", float(size.max()), "deg", "run", f"largest error of a turn; {where}"
    )


if __name__ == "__main__":
    main()
