"""Points are met by the row that is being read when the camera is where that row sees them."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.geometry.camera import project, rays
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp, transform
from scanloom.stages.geometry.shutter import Sweep, as_met

PLAIN = {"width_px": 640, "height_px": 400, "fx_px": 400.0, "fy_px": 400.0, "cx_px": 319.5, "cy_px": 199.5}
MODELS = {
    "pinhole": CameraModel(lens="pinhole", **PLAIN),
    "equidistant": CameraModel(lens="equidistant", distortion=(-0.02, 0.003, 0.0, 0.0), **PLAIN),
}
READOUT_S = 0.05
PLACE = pose(so3_exp(np.array([0.3, -1.0, 0.7])), np.array([4.0, -3.0, 2.0]))
HARD = np.array([0.6, 0.8, -0.5]), np.array([2.0, 1.0, 20.0])
"""Turn, rad/s, and speed, m/s, in the camera's axes: a bend on a bad road at 70 km/h."""


def where(t_s: float, motion: tuple[F8, F8] = HARD) -> F8:
    """T_world_camera of a steady motion, s from the middle row."""
    turn, speed = motion
    return PLACE @ pose(so3_exp(turn * t_s), speed * t_s)


def sweep(motion: tuple[F8, F8] = HARD) -> Sweep:
    return Sweep.between(*(where(share * READOUT_S, motion) for share in (-0.5, 0.0, 0.5)))


def scene(model: CameraModel, count: int = 300) -> tuple[F8, F8]:
    """Pixels (n, 2) anywhere in the image and points of the world (n, 3), 3 to 40 m away, that their rows show there."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, 0), (model.width_px - 1, model.height_px - 1), (count, 2))
    ahead = rays(model, pixels) * rng.uniform(3.0, 40.0, (count, 1))
    times = READOUT_S * (pixels[:, 1] / (model.height_px - 1) - 0.5)
    return pixels, np.stack([transform(where(t), p[None])[0] for t, p in zip(times, ahead)])


@pytest.mark.parametrize("lens", MODELS)
def test_points_are_projected_to_where_their_rows_show_them(lens: str) -> None:
    model = MODELS[lens]
    pixels, points = scene(model)
    still = transform(inverse(PLACE), points)
    before = np.linalg.norm(project(model, still)[0] - pixels, axis=1)
    after = np.linalg.norm(project(model, as_met(model, sweep(), still))[0] - pixels, axis=1)
    assert 3.0 < np.median(before) < 30.0
    assert np.quantile(after, 0.95) < 0.02
    assert after.max() < 0.2


def test_a_camera_that_stands_sees_points_where_they_are() -> None:
    model = MODELS["pinhole"]
    _, points = scene(model)
    still = transform(inverse(PLACE), points)
    at_rest = Sweep.between(PLACE, PLACE, PLACE)
    assert at_rest.turned_rad == 0.0
    assert as_met(model, at_rest, still) == pytest.approx(still, abs=1e-12)


def test_what_no_row_shows_stays_out_of_the_image() -> None:
    model = MODELS["pinhole"]
    behind = np.array([[0.0, 0.0, -5.0], [1.0, 1.0, -0.1], [0.0, 0.0, 0.0]])
    above = np.array([[0.0, -30.0, 10.0], [0.0, 30.0, 10.0]])
    met = as_met(model, sweep(), np.concatenate((behind, above)))
    assert np.isfinite(met).all()
    assert not project(model, met)[1].any()


def test_a_sweep_is_what_the_camera_does_from_first_to_last_row() -> None:
    found = sweep()
    assert found.turn == pytest.approx(HARD[0] * READOUT_S, abs=1e-9)
    assert found.shift == pytest.approx(HARD[1] * READOUT_S, abs=1e-9)
    assert found.turned_rad == pytest.approx(np.linalg.norm(HARD[0]) * READOUT_S)
