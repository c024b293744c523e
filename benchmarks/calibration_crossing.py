"""Where the beams of the real LiDAR cross: what the clouds say of it without images, and what placements left out say.

python -m benchmarks.calibration_crossing [--data FOLDER] [--json -]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.calibration import DATA, PUBLISHED_M, PUBLISHED_RPY, SPREAD_M
from benchmarks.scores import Figure
from scanloom.stages.calibrate import calibration as story
from scanloom.stages.calibrate.acceptance import together
from scanloom.stages.calibrate.cloud import CloudSettings
from scanloom.stages.calibrate.cloud.evidence import SENSOR
from scanloom.stages.calibrate.noise import Noise
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.calibrate.view import Sensor, rows_of
from scanloom.stages.geometry.se3 import F8, so3_exp, transform
from scanloom.workflows.calibrate_rig import look
from scanloom.workflows.calibration_folder import read_session

HELD_MM = (0, 10, 20, 30, 42)
"""42: the maker's table."""
HALVES = 6
SQUARES = (0.995, 1.005)
HELD_SPREADS = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
"""Where the camera is held along x, from the published mean."""
PUBLISHED_R = Rotation.from_euler("xyz", PUBLISHED_RPY).as_matrix()
"""R = Rz Ry Rx."""
_CROSSING, _FARTHER = SENSOR.index("crossing_m"), SENSOR.index("farther_m")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--json", default="")
    arguments = parser.parse_args()
    folder = arguments.data / "lidar_camera_board"
    if not folder.is_dir():
        print(f"real data is absent: {folder}")
        return
    scene = look(read_session(folder, None), CloudSettings()).scene
    figures = []
    for figure in (*by_clouds(scene), *by_placements(scene), *by_place(scene)):
        figures.append(figure)
        print(
            f"{figure.scope:34} {figure.name:34} {figure.value:10.4f} {figure.unit:5} {figure.method}",
            flush=True,
        )
    if arguments.json:
        text = json.dumps([figure.row() for figure in figures], indent=1)
        print(text) if arguments.json == "-" else Path(arguments.json).write_text(text + "\n")


def by_clouds(scene: Scene) -> Iterator[Figure]:
    """No image is used: boards of known outline and print, each somewhere."""
    mean, sigma = alone(scene)
    for name, i in (("crossing", _CROSSING), ("farther", _FARTHER)):
        yield Figure(
            f"calibration.{name}_mm", 1e3 * mean[i], "mm", "clouds alone", f"{len(scene.names)} boards"
        )
        yield Figure(f"calibration.{name}_sigma_mm", 1e3 * sigma[i], "mm", "clouds alone", "as the fit says")
    rng = np.random.default_rng(0)
    size = len(scene.names) // 2
    halves = [alone(scene.only(rng.permutation(scene.names)[:size]))[0][_CROSSING] for _ in range(HALVES)]
    for name, value in (("least", min(halves)), ("most", max(halves))):
        yield Figure(
            f"calibration.crossing_{name}_mm", 1e3 * value, "mm", "clouds alone", f"of {HALVES} random halves"
        )


def alone(scene: Scene) -> tuple[F8, F8]:
    """What the LiDAR is off by and its standard deviations, by clouds: poses of the boards eliminated by QR."""
    noise = Noise()
    sensor = Sensor.unknown(scene.beams, noise)
    H, g = np.linalg.inv(sensor.covariance), np.zeros(len(sensor.mean))
    for p in scene.placements:
        rows = rows_of(p.cloud, sensor, noise)
        triangle = np.linalg.qr(np.column_stack((rows.by_board, rows.by_sensor, rows.gap)), mode="r")[6:, 6:]
        H += triangle[:, :-1].T @ triangle[:, :-1]
        g += triangle[:, :-1].T @ triangle[:, -1]
    covariance = np.linalg.inv(H)
    return -covariance @ g, np.sqrt(np.diag(covariance))


def by_placements(scene: Scene) -> Iterator[Figure]:
    """Whole calibrations with other beliefs of the sensors."""
    plain = Noise()
    sigma = list(plain.sensor_m)
    held = replace(plain, sensor_m=_but(sigma, _CROSSING, 0.0))
    ways = {f"crossing held at {mm} mm": (held, crossed(scene, 1e-3 * mm)) for mm in HELD_MM}
    ways |= {
        "crossing estimated": (plain, scene),
        "ranges believed": (replace(plain, sensor_m=_but(sigma, _FARTHER, 0.0)), scene),
        "focal length free by 0.2 %": (replace(plain, lens_share=0.002), scene),
        "all of the LiDAR believed": (plain.believing(), scene),
    }
    for share in SQUARES:
        board = scene.board.model_copy(update={"square_m": share * scene.board.square_m})
        ways[f"squares of {share:g} of their size"] = plain, replace(scene, board=board)
    for scope, (noise, seen) in ways.items():
        with patch.object(story, "_noise", lambda _, noise=noise: noise):
            found = story.calibrate(seen, CalibrateSettings(halves=0))
        camera = seen.cameras[0]
        off = (found.estimate.T_lidar_camera[camera][:3, 3] - PUBLISHED_M) / SPREAD_M
        left_out = together(list(found.checks.left_out.values()))
        yield Figure(
            "calibration.leave_one_out_px", left_out.px, "px", scope, f"rms of {left_out.corners} corners"
        )
        for axis, sigmas in zip("xyz", off):
            yield Figure(
                f"calibration.{axis}_published_sigmas",
                float(sigmas),
                "",
                scope,
                "from the published mean, in spreads",
            )


def by_place(scene: Scene) -> Iterator[Figure]:
    """How well the images can be explained at all with the camera held along x: boards where the clouds have them, all the rest free."""
    for scope, noise in (("LiDAR estimated", Noise()), ("LiDAR believed", Noise().believing())):
        with patch.object(story, "_noise", lambda _, noise=noise: noise):
            found = story.calibrate(scene, CalibrateSettings(halves=0))
        for spreads in HELD_SPREADS:
            px = _held(found, PUBLISHED_M[0] + spreads * SPREAD_M[0])
            how = f"x held {spreads:g} spreads from the published mean, the rest fitted to all corners"
            yield from _fitted(px, f"{scope}, x {spreads:g} spreads", how)
        yield from _fitted(_errors(found, PUBLISHED_R, PUBLISHED_M), f"{scope}, published", "nothing fitted")
        how = "the camera at the published place, its turn fitted to all corners"
        yield from _fitted(_turned(found, PUBLISHED_M), f"{scope}, published place", how)


def _fitted(errors_px: F8, scope: str, how: str) -> Iterator[Figure]:
    """Of errors (N, 2) of all corners, px: root mean square and mean of their lengths."""
    px = np.linalg.norm(errors_px, axis=1)
    yield Figure("calibration.fitted_px", float(np.sqrt(np.mean(px**2))), "px", scope, f"rms; {how}")
    yield Figure("calibration.fitted_mean_px", float(px.mean()), "px", scope, f"mean; {how}")


def _held(found: story.Found, x_m: float) -> F8:
    """Errors of all corners (N, 2), px, least in the sample with the camera's place along x held; by turns and the other two places."""
    T = found.estimate.T_lidar_camera[found.scene.cameras[0]]

    def errors(free: F8) -> F8:
        return _errors(found, T[:3, :3] @ so3_exp(free[:3]), np.array([x_m, *free[3:]])).ravel()

    return least_squares(errors, np.r_[np.zeros(3), T[1:3, 3]]).fun.reshape(-1, 2)


def _turned(found: story.Found, place_m: F8) -> F8:
    """Errors of all corners (N, 2), px, least in the sample with the camera's place held; by turns."""
    R = found.estimate.T_lidar_camera[found.scene.cameras[0]][:3, :3]
    fit = least_squares(lambda turn: _errors(found, R @ so3_exp(turn), place_m).ravel(), np.zeros(3))
    return fit.fun.reshape(-1, 2)


def _errors(found: story.Found, R_lidar_camera: F8, place_m: F8) -> F8:
    """Errors (N, 2), px, of all corners of boards where the clouds have them, by a camera so turned in that place."""
    scene, camera = found.scene, found.scene.cameras[0]
    bearings = scene.bearings()
    boards = {p.name: found.estimate.board_by_cloud(p, found.noise) for p in scene.placements}
    seen = (
        (
            bearings[p.name, camera],
            (transform(boards[p.name], scene.corners(p, camera)) - place_m) @ R_lidar_camera,
        )
        for p in scene.placements
    )
    return np.concatenate([bearing.errors(points)[0] for bearing, points in seen])


def crossed(scene: Scene, crossing_m: float) -> Scene:
    """The scene with clouds that are right for beams which cross there."""
    column = 6 + _CROSSING
    views = (
        replace(p, cloud=replace(p.cloud, gap=p.cloud.gap + p.cloud.root[:, column] * crossing_m))
        for p in scene.placements
    )
    return replace(scene, placements=tuple(views))


def _but(values: list[float], index: int, value: float) -> tuple[float, ...]:
    return tuple(value if i == index else v for i, v in enumerate(values))


if __name__ == "__main__":
    main()
