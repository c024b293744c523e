"""Intrinsics that a graph may move."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.board_scenes import model
from scanloom.stages.calibrate.lens import by_intrinsics, corrected, prior_sigmas
from scanloom.stages.geometry.camera import project, rays


@pytest.mark.parametrize("number", [0, 1, 2])
def test_pixels_move_as_the_derivatives_say(number: int) -> None:
    lens = model(number)
    pixels = np.random.default_rng(0).uniform(
        (100, 100), (lens.width_px - 100, lens.height_px - 100), (20, 2)
    )
    directions = rays(lens, pixels)
    moves = by_intrinsics(lens, directions)
    assert moves.shape == (20, 2, 4 + len(lens.distortion))
    shift = np.r_[0.5, -0.4, 0.3, 0.2, np.full(len(lens.distortion), 1e-4)]
    there, _ = project(corrected(lens, shift), directions)
    np.testing.assert_allclose(there - pixels, moves @ shift, atol=2e-3)
    assert np.abs(there - pixels).max() > 0.2


def test_priors_are_pixels_at_a_corner_of_the_image() -> None:
    lens = model(0)
    sigmas = prior_sigmas(lens, 0.01, 2.0)
    np.testing.assert_allclose(sigmas[:4], 0.01 * lens.fx_px)
    corner = rays(lens, np.array([[0.0, 0.0]]))
    for k, sigma in enumerate(sigmas[4:]):
        shift = np.zeros(4 + len(lens.distortion))
        shift[4 + k] = sigma
        moved = np.linalg.norm(project(corrected(lens, shift), corner)[0])
        assert 1.0 < moved < 2.1
    assert prior_sigmas(lens, 0.0, 0.0).max() < 1e-5
