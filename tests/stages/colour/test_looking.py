"""What an image cannot show is left out before it is looked at, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.colour.looking import widest_cosine
from scanloom.stages.colour.surroundings import Cone, Ground
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.shutter import Sweep, as_met
from tests.stages.colour.scene import MODEL

PLAIN = {"width_px": 640, "height_px": 400, "cx_px": 300.0, "cy_px": 220.0}
MODELS = {
    "pinhole": MODEL,
    "radial-tangential": CameraModel(
        lens="radial-tangential", fx_px=350, fy_px=355, distortion=(-0.2, 0.04, 1e-3, -1e-3), **PLAIN
    ),
    "folding": CameraModel(lens="radial-tangential", fx_px=250, fy_px=250, distortion=(-0.5, 0.0, 0, 0), **PLAIN),
    "fisheye": CameraModel(lens="equidistant", fx_px=160, fy_px=160, distortion=(0.0,) * 4, **PLAIN),
    "beyond half a sphere": CameraModel(lens="equidistant", fx_px=90, fy_px=90, distortion=(0.0,) * 4, **PLAIN),
}  # fmt: skip


def directions(count: int = 200_000) -> np.ndarray:
    v = np.random.default_rng(0).normal(size=(count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.mark.parametrize("name", MODELS)
def test_all_that_an_image_shows_is_in_its_cone(name: str) -> None:
    points = 10.0 * directions()
    shown = project(MODELS[name], points)[1]
    ground = Ground(np.arange(len(points)), points, np.zeros((len(points), 3), np.float32))
    cone = Cone(np.zeros(3), np.array([0.0, 0.0, 1.0]), widest_cosine(MODELS[name]), 10.1)
    within = ground.within(cone)
    assert shown.sum() > 1000
    assert np.isin(np.flatnonzero(shown), within).all()
    if name in ("pinhole", "fisheye"):
        assert len(within) < 4 * shown.sum()
    assert not len(ground.within(Cone(cone.tip, cone.axis, cone.cosine, 9.9)))


def test_a_camera_that_turns_while_it_reads_an_image_shows_more() -> None:
    points = 10.0 * directions()
    sweep = Sweep(np.array([-0.08, 0.0, 0.02]), np.zeros(3))
    shown = project(MODEL, as_met(MODEL, sweep, points))[1]
    forward = points[:, 2] / 10.0
    assert (forward[shown] >= widest_cosine(MODEL, sweep.turned_rad)).all()
    assert (forward[shown] < widest_cosine(MODEL)).any()
