"""Lenses against OpenCV, and there and back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from scanloom.schemas.cameras import CameraModel, Lens
from scanloom.stages.geometry.camera import field, project, rays, undistorted

SIZE = {"width_px": 1280, "height_px": 960}
INNER = {"fx_px": 640.0, "fy_px": 630.0, "cx_px": 655.5, "cy_px": 470.25}


def lens(kind: Lens, *distortion: float) -> CameraModel:
    return CameraModel(lens=kind, distortion=distortion, **SIZE, **INNER)


LENSES = (
    lens("pinhole"),
    lens("radial-tangential", -0.28, 0.09, 1e-3, -6e-4),
    lens("radial-tangential", -0.28, 0.09, 1e-3, -6e-4, -0.011),
    lens("radial-tangential", 0.35, -0.12, 3e-4, 2e-4, 0.006, 0.68, -0.13, 0.01),
    lens("equidistant", -0.03, 0.008, -0.006, 0.001),
)


def matrix(model: CameraModel) -> np.ndarray:
    return np.array([[model.fx_px, 0, model.cx_px], [0, model.fy_px, model.cy_px], [0, 0, 1.0]])


def ahead(n: int = 500) -> np.ndarray:
    """Points before the camera, within 55 degrees of its axis."""
    rng = np.random.default_rng(3)
    angle, turn, far = (
        np.radians(55) * np.sqrt(rng.random(n)),
        rng.uniform(0, 2 * np.pi, n),
        rng.uniform(1, 60, n),
    )
    across = np.sin(angle)
    return far[:, None] * np.column_stack((across * np.cos(turn), across * np.sin(turn), np.cos(angle)))


@pytest.mark.parametrize("model", LENSES, ids=lambda m: f"{m.lens}-{len(m.distortion)}")
def test_pixels_are_those_of_opencv(model: CameraModel) -> None:
    points, still, distortion = ahead(), np.zeros(3), np.array(model.distortion or (0.0,) * 4)
    if model.lens == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix(model), distortion)
    else:
        expected, _ = cv2.projectPoints(points, still, still, matrix(model), distortion)
    pixels, seen = project(model, points)
    within = np.abs(expected[:, 0] - (639.5, 479.5)) <= (640.0, 480.0)
    assert 200 < seen.sum() < 500
    np.testing.assert_array_equal(seen, within.all(axis=1))
    np.testing.assert_allclose(pixels[seen], expected[seen, 0], atol=1e-9)


@pytest.mark.parametrize("model", LENSES, ids=lambda m: f"{m.lens}-{len(m.distortion)}")
def test_there_and_back(model: CameraModel) -> None:
    u, v = np.meshgrid(np.linspace(-0.49, 1279.49, 41), np.linspace(-0.49, 959.49, 31))
    pixels = np.column_stack((u.ravel(), v.ravel()))
    directions = rays(model, pixels)
    reached = np.isfinite(directions).all(axis=1)
    assert reached.mean() > 0.75
    np.testing.assert_allclose(np.linalg.norm(directions[reached], axis=1), 1.0, atol=1e-14)
    again, seen = project(model, directions[reached] * 7.0)
    assert seen.all()
    np.testing.assert_allclose(again, pixels[reached], atol=2e-9)
    points = ahead()
    pixels, seen = project(model, points)
    unit = points[seen] / np.linalg.norm(points[seen], axis=1, keepdims=True)
    np.testing.assert_allclose(rays(model, pixels[seen]), unit, atol=1e-11)


@pytest.mark.parametrize("model", LENSES, ids=lambda m: f"{m.lens}-{len(m.distortion)}")
def test_what_is_behind_or_nowhere_is_not_seen(model: CameraModel) -> None:
    points = np.array(
        [
            [0, 0, -3.0],
            [0.2, 0.1, -3.0],
            [0, 0, 0],
            [1, 0, 0],
            [np.nan, 0, 1],
            [0, 0, np.inf],
            [0, 0, 1e-300],
            [0, 0, 2],
        ]
    )
    pixels, seen = project(model, points)
    np.testing.assert_array_equal(seen[[0, 1, 2, 3, 4]], False)
    assert seen[7]
    np.testing.assert_allclose(pixels[7], (655.5, 470.25))


def test_beyond_the_fold_nothing_is_seen() -> None:
    """r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9); a point further out would come back into the image."""
    model = lens("radial-tangential", -0.3, 0.0, 0.0, 0.0)
    edge = 1.0 / np.sqrt(0.9)
    assert field(model) == pytest.approx(edge)
    xs = np.array([0.5, edge * 0.999, edge * 1.001, 1.6])
    folded, _ = cv2.projectPoints(
        np.column_stack((0 * xs, xs, 0 * xs + 1)),
        np.zeros(3),
        np.zeros(3),
        matrix(model),
        np.array(model.distortion),
    )
    assert 0 < folded[3, 0, 1] < 960
    _, seen = project(model, np.column_stack((0 * xs, xs, 0 * xs + 1)))
    np.testing.assert_array_equal(seen, [True, True, False, False])
    reach = edge * (1 - 0.3 * edge**2)
    v = model.cy_px + model.fy_px * reach * np.array([0.99, 1.01])
    directions = rays(model, np.column_stack((np.full(2, model.cx_px), v)))
    np.testing.assert_array_equal(np.isfinite(directions[:, 0]), [True, False])


def test_a_fisheye_sees_more_than_a_half_space() -> None:
    model = CameraModel(lens="equidistant", width_px=1200, height_px=1200, fx_px=300, fy_px=300, cx_px=600, cy_px=600,
                        distortion=(0.0, 0.0, 0.0, 0.0))  # fmt: skip
    assert field(model) == pytest.approx(np.pi)
    angles = np.radians(
        [100.0, 114.0, 115.0]
    )  # the image's right edge lies at 599.5 / 300 rad = 114.5 degrees
    pixels, seen = project(model, np.column_stack((np.sin(angles), 0 * angles, np.cos(angles))))
    np.testing.assert_array_equal(seen, [True, True, False])
    np.testing.assert_allclose(pixels[:, 0], 600 + 300 * angles)
    np.testing.assert_allclose(rays(model, pixels[:2])[:, 2], np.cos(angles[:2]), atol=1e-12)


def test_a_fisheye_folds_too() -> None:
    model = lens("equidistant", -0.2, 0.0, 0.0, 0.0)
    assert field(model) == pytest.approx(np.sqrt(1 / 0.6))
    _, seen = project(model, np.array([[0, np.tan(np.radians(40)), 1.0], [0, np.sin(2.2), np.cos(2.2)]]))
    np.testing.assert_array_equal(seen, [True, False])


def test_the_image_ends_half_a_pixel_beyond_its_outer_pixels() -> None:
    model = lens("pinhole")
    pixels = np.array([[-0.5, 0], [-0.501, 0], [1279.499, 0], [1279.5, 0], [0, 959.499], [0, 959.5]])
    _, seen = project(model, rays(model, pixels + 1e-7 * np.array([1, 0])))
    np.testing.assert_array_equal(seen, [True, False, True, False, True, False])


def test_nothing_gives_nothing() -> None:
    for model in LENSES:
        pixels, seen = project(model, np.empty((0, 3)))
        assert pixels.shape == (0, 2) and seen.shape == (0,)
        assert rays(model, np.empty((0, 2))).shape == (0, 3)


def test_a_straight_lens_of_the_same_size() -> None:
    straight = undistorted(LENSES[4])
    assert straight.lens == "pinhole" and straight.distortion == () and straight.fx_px == 640.0


def test_a_lens_has_its_number_of_coefficients() -> None:
    with pytest.raises(ValidationError, match="has 4 or 5 or 8 coefficients, not 3"):
        lens("radial-tangential", 0.1, 0.2, 0.3)
    with pytest.raises(ValidationError, match="has 0 coefficients"):
        lens("pinhole", 0.1)
