"""Mean map entropy against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.geometry.entropy import mean_entropy, point_entropies


@pytest.mark.parametrize("sigma_m", [0.01, 0.02, 0.04])
def test_entropy_of_a_noisy_plane_is_known_in_closed_form(sigma_m: float) -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(0, 8, (60_000, 2)), rng.normal(0, sigma_m, 60_000)))
    inner = np.flatnonzero(((points[:, :2] > 1) & (points[:, :2] < 7)).all(axis=1))[:1500]
    radii = (0.3, 0.5, 1.0)
    mean, share = mean_entropy(point_entropies(points.astype(np.float32), inner, radii, 6))
    want = [0.5 * np.log((2 * np.pi * np.e) ** 3 * r**4 * sigma_m**2 / 16) for r in radii]
    assert share.tolist() == [1.0, 1.0, 1.0]
    assert (
        np.abs(mean - want) < 0.03 + 3 * (sigma_m / np.array(radii)) ** 2
    ).all()  # exact for a thin plane only
    assert np.abs(mean - want).max() > 0.0005


def test_entropy_equals_the_textbook_formula_point_by_point() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(0, 1.5, (800, 3)).astype(np.float32)
    queries = np.arange(0, 800, 40)
    got = point_entropies(points, queries, (0.5, 1.5), 6)
    for row, q in enumerate(queries):
        for k, radius in enumerate((0.5, 1.5)):
            near = points[np.linalg.norm(points.astype(float) - points[q], axis=1) <= radius].astype(float)
            if len(near) < 6:
                assert np.isnan(got[row, k])
            else:
                sign, logdet = np.linalg.slogdet(2 * np.pi * np.e * np.cov(near.T))
                assert sign > 0
                assert got[row, k] == pytest.approx(0.5 * logdet, abs=1e-6)


def test_entropy_skips_lonely_points_and_perfect_planes() -> None:
    flat = np.column_stack((np.random.default_rng(0).uniform(0, 1, (50, 2)), np.zeros(50))).astype(np.float32)
    assert np.isnan(point_entropies(flat, np.arange(50), (0.5,), 6)).all()
    mean, share = mean_entropy(point_entropies(flat[:3], np.arange(3), (0.5,), 6))
    assert np.isnan(mean[0])
    assert share[0] == 0.0
    with pytest.raises(ValueError, match="increase"):
        point_entropies(flat, np.arange(3), (1.0, 0.5), 6)
