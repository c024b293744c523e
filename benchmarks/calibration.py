"""Calibration: real placements against published solutions, and simulated rigs against truth.

    python -m benchmarks.calibration [--data FOLDER] [--seeds 100] [--first 0] [--only real|rigs|starts|bad] [--json -]

`real` needs the folder `lidar_camera_board` of real data; the others need nothing.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np

from benchmarks.board_scenes import World, glared, other_board, shifted, simulate
from benchmarks.scores import Figure
from scanloom.schemas.errors import InvalidInput
from scanloom.stages.calibrate import calibration as story
from scanloom.stages.calibrate.acceptance import Checks, together
from scanloom.stages.calibrate.calibration import Found, calibrate
from scanloom.stages.calibrate.cloud import CloudSettings
from scanloom.stages.calibrate.exports import roll_pitch_yaw
from scanloom.stages.calibrate.rays import turn_and_shift
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log, so3_exp
from scanloom.workflows.calibrate_rig import look
from scanloom.workflows.calibration_folder import read_session

DATA = Path(__file__).resolve().parents[1] / "../shared/data"
PUBLISHED_M = np.array([0.0626, 0.0039, -0.1958])
"""Mean of 50 published solutions, camera to LiDAR: x y z, m, in the LiDAR's frame; their spread below."""
SPREAD_M = np.array([0.004, 0.018, 0.030])
PUBLISHED_RPY = np.array([-1.6954, -0.0209, -1.4929])
GOAL_DEG, GOAL_MM, SIGMAS = 0.05, 3.0, 3.0
CHI2_3_SIGMA = 20.06
"""What chi-square with six degrees of freedom exceeds as rarely as a normal variable three standard deviations."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", choices=("real", "rigs", "starts", "bad"), default=None)
    parser.add_argument("--json", default="")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    runs = {
        "real": lambda: real(arguments.data / "lidar_camera_board"),
        "rigs": lambda: rigs(seeds),
        "starts": lambda: starts(seeds),
        "bad": lambda: bad(seeds),
    }
    figures: list[Figure] = []
    for name, run in runs.items():
        if arguments.only in (None, name):
            for figure in run():
                figures.append(figure)
                print(
                    f"{figure.scope:22} {figure.name:34} {figure.value:10.4f} {figure.unit:5} {figure.method}",
                    flush=True,
                )
    if arguments.json:
        text = json.dumps([figure.row() for figure in figures], indent=1)
        print(text) if arguments.json == "-" else Path(arguments.json).write_text(text + "\n")


# --- real ------------------------------------------------------------------------------------------------------------


def real(folder: Path) -> Iterator[Figure]:
    """Three ways over the same boards: ours, ours with a LiDAR that is off in nothing, the published method."""
    if not folder.is_dir():
        print(f"real data is absent: {folder}")
        return
    begun = time.perf_counter()
    session = read_session(folder, None)
    looked = look(session, CloudSettings())
    yield Figure(
        "calibration.looking_s",
        time.perf_counter() - begun,
        "s",
        "board",
        "boards in all clouds and images, one core",
    )
    ways = {
        "board": CalibrateSettings(),
        "board, LiDAR believed": CalibrateSettings(lidar="believed"),
        "paper": CalibrateSettings(method="paper"),
    }
    for scope, settings in ways.items():
        begun = time.perf_counter()
        found = calibrate(looked.scene, settings)
        yield from _real_rows(scope, found)
        yield Figure(
            "calibration.solving_s",
            time.perf_counter() - begun,
            "s",
            scope,
            "calibration with all its checks, one core",
        )


def _real_rows(scope: str, found: Found) -> Iterator[Figure]:
    camera = found.scene.cameras[0]
    T = found.estimate.T_lidar_camera[camera]
    off = (T[:3, 3] - PUBLISHED_M) / SPREAD_M
    angles = np.array(roll_pitch_yaw(T[:3, :3])) - PUBLISHED_RPY
    sigma = np.sqrt(np.diag(found.estimate.camera_covariance(camera)))
    checks, spread = found.checks, found.checks.spread[camera]

    def row(name: str, value: float, unit: str, method: str) -> Figure:
        return Figure(f"calibration.{name}", float(value), unit, scope, method)

    for axis, place, sigmas in zip("xyz", T[:3, 3], off):
        yield row(f"{axis}_m", place, "m", "camera in the LiDAR's frame")
        yield row(
            f"{axis}_published_sigmas", sigmas, "", "from the mean of 50 published solutions, in their spread"
        )
    for axis, angle in zip(("roll", "pitch", "yaw"), angles):
        yield row(
            f"{axis}_off_deg",
            np.degrees(angle),
            "deg",
            "from the published mean, whose spread of angles is unknown",
        )
    yield row(
        "sigma_deg",
        np.degrees(sigma[:3].max()),
        "deg",
        "largest standard deviation of a turn, as the calibration says",
    )
    yield row(
        "sigma_mm",
        1e3 * sigma[3:].max(),
        "mm",
        "largest standard deviation of a shift, as the calibration says",
    )
    for name, misses in (
        ("leave_one_out", checks.left_out),
        ("leave_one_out_as_read", checks.left_out_as_read),
    ):
        whole = together(list(misses.values()))
        yield row(f"{name}_px", whole.px, "px", f"rms of {whole.corners} corners")
        yield row(f"{name}_cm", whole.cm, "cm", "the same on the board's plane")
    held = together([m for several in checks.held_out.values() for m in several])
    yield row("held_out_px", held.px, "px", f"by {spread.halves} random halves, on the other half")
    yield row("held_out_cm", held.cm, "cm", f"by {spread.halves} random halves, on the other half")
    yield row(
        "halves_max_deg",
        np.degrees(spread.rotation_max_rad),
        "deg",
        f"{spread.halves} random halves from their mean",
    )
    yield row(
        "halves_max_cm",
        100 * spread.translation_max_m,
        "cm",
        f"{spread.halves} random halves from their mean",
    )


# --- simulated -------------------------------------------------------------------------------------------------------


def rigs(seeds: range) -> Iterator[Figure]:
    """Three cameras, 12 placements, range noise 2 cm."""
    yield from _against_truth("rigs", seeds, lambda seed, scene, poses: calibrate(scene, CalibrateSettings()))


def starts(seeds: range) -> Iterator[Figure]:
    """The same from starts that are 20 degrees and 0.5 m off."""

    def run(seed: int, scene: Scene, poses: dict[str, F8]) -> Found:
        rng = np.random.default_rng(10_000 + seed)
        given = {name: T @ _off(rng, np.radians(20.0), 0.5) for name, T in poses.items()}
        return calibrate(scene, CalibrateSettings(start="given"), given)

    yield from _against_truth("starts 20 deg 0.5 m", seeds, run)


def _off(rng: np.random.Generator, turn_rad: float, shift_m: float) -> F8:
    axis, way = rng.normal(size=3), rng.normal(size=3)
    return pose(so3_exp(turn_rad * axis / np.linalg.norm(axis)), shift_m * way / np.linalg.norm(way))


def _against_truth(scope: str, seeds: range, run) -> Iterator[Figure]:  # type: ignore[no-untyped-def]
    """Errors of all cameras, and how many seeds have the truth within three sigma everywhere."""
    errors, within, refused = [], 0, 0
    for seed in seeds:
        scene, poses = simulate(World(), seed)
        with patch.object(story, "check", _unchecked):
            try:
                found = run(seed, scene, poses)
            except InvalidInput as error:
                refused += 1
                print(f"seed {seed}: {error}")
                continue
        inside = True
        for camera, T in found.estimate.T_lidar_camera.items():
            turn, shift = turn_and_shift(poses[camera], T)
            errors.append((np.degrees(turn), 1e3 * shift))
            xi = se3_log(inverse(poses[camera]) @ T)
            covariance = found.estimate.camera_covariance(camera)
            inside &= bool(xi @ np.linalg.solve(covariance, xi) < CHI2_3_SIGMA)
            inside &= bool((np.abs(xi) < SIGMAS * np.sqrt(np.diag(covariance))).all())
        within += inside
    deg, mm = np.array(errors).T
    how = f"{len(errors)} cameras of {len(seeds)} rigs"
    yield Figure(
        "calibration.error_rms_deg",
        float(np.sqrt((deg**2).mean())),
        "deg",
        scope,
        f"rms turn from truth, {how}",
    )
    yield Figure(
        "calibration.error_rms_mm",
        float(np.sqrt((mm**2).mean())),
        "mm",
        scope,
        f"rms shift from truth, {how}",
    )
    yield Figure(
        "calibration.error_p95_deg", float(np.percentile(deg, 95)), "deg", scope, f"95th percentile, {how}"
    )
    yield Figure(
        "calibration.error_p95_mm", float(np.percentile(mm, 95)), "mm", scope, f"95th percentile, {how}"
    )
    share = float(np.mean((deg < GOAL_DEG) & (mm < GOAL_MM)))
    yield Figure(
        "calibration.goal_share", share, "", scope, f"cameras within {GOAL_DEG} degrees and {GOAL_MM} mm"
    )
    yield Figure(
        "calibration.within_3_sigma",
        within,
        "",
        scope,
        f"of {len(seeds)} rigs, all cameras, every axis and all together",
    )
    yield Figure("calibration.refused", refused, "", scope, f"of {len(seeds)} rigs")


def _unchecked(*_: object) -> Checks:
    """Leaving out and halves take most of the time and change nothing."""
    return Checks({}, {}, {}, {}, {})


def bad(seeds: range) -> Iterator[Figure]:
    """Three of 12 placements spoilt: the board moved by 8 cm between cloud and images, glare, another board."""
    named = falsely = refused = 0
    for seed in seeds:
        world = World()
        scene, poses = simulate(world, seed)
        spoilt, scene = _spoilt(world, scene, poses, np.random.default_rng(20_000 + seed))
        with patch.object(story, "check", _unchecked):
            try:
                found = calibrate(scene, CalibrateSettings())
            except InvalidInput as error:
                refused += 1
                print(f"seed {seed}: {error}")
                continue
        left_out = {name for name, _ in found.left_out}
        named += spoilt <= left_out
        falsely += len(left_out - spoilt)
    yield Figure(
        "calibration.bad_named",
        named,
        "",
        "3 bad of 12",
        f"of {len(seeds)} rigs, all three named and left out",
    )
    yield Figure(
        "calibration.good_left_out",
        falsely,
        "",
        "3 bad of 12",
        f"good placements with an image left out, {len(seeds)} rigs",
    )
    yield Figure(
        "calibration.bad_refused",
        refused,
        "",
        "3 bad of 12",
        f"of {len(seeds)} rigs: too little left for a camera",
    )


def _spoilt(
    world: World, scene: Scene, poses: dict[str, F8], rng: np.random.Generator
) -> tuple[set[str], Scene]:
    placements = list(scene.placements)
    a, b, c = (int(i) for i in rng.permutation(len(placements))[:3])
    placements[a] = shifted(placements[a], _off(rng, 0.0, 0.08))
    placements[b] = glared(placements[b], scene.models, world.board, rng)
    placements[c] = other_board(placements[c], scene.models, poses, world, rng)
    return {placements[i].name for i in (a, b, c)}, Scene.of(scene.board, scene.models, tuple(placements))


if __name__ == "__main__":
    main()
