"""From a camera's own axes into its image and back: pinhole, radial-tangential and equidistant lenses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel

Floats = NDArray[np.float64]

_STEPS = 30
"""Newton steps of the inverse at most; it converges in five where the lens is well behaved."""
_CLOSE_PX = 1e-10
_EDGE = 1.0 - 1e-9


def project(model: CameraModel, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Pixels (n, 2) of points (n, 3) in the camera's axes (x right, y down, z forward), and which are seen (n,).

    Seen is what lies in front, within the lens's valid field (`field`: beyond it the polynomial folds back and would
    put points into the middle of the image) and inside the image. Pixels of what is not seen are NaN where they have
    no meaning, else they lie outside the image. Formulas: OpenCV's, for radial-tangential (Brown 1966) and equidistant
    (Kannala and Brandt 2006); an equidistant lens may see more than a half-space.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    plane, valid = _onto_plane(model, points)
    pixels = plane * (model.fx_px, model.fy_px) + (model.cx_px, model.cy_px)
    pixels[~valid] = np.nan
    return pixels, valid & inside(model, pixels)


def rays(model: CameraModel, pixels: Floats) -> Floats:
    """Unit directions (n, 3) in the camera's axes which `project` takes to `pixels` (n, 2), to 1e-9 px.

    NaN for a pixel that no direction within the lens's valid field reaches.
    """
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    plane = (pixels - (model.cx_px, model.cy_px)) / (model.fx_px, model.fy_px)
    if model.lens == "equidistant":
        return _from_angles(model, plane)
    straight = plane if model.lens == "pinhole" else _straightened(model, plane)
    directions = np.column_stack((straight, np.ones(len(straight))))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def inside(model: CameraModel, pixels: Floats) -> NDArray[np.bool_]:
    """Which pixels (n, 2) lie within the image: up to half a pixel around the centres of its outer pixels."""
    u, v = pixels[:, 0], pixels[:, 1]
    return (u >= -0.5) & (u < model.width_px - 0.5) & (v >= -0.5) & (v < model.height_px - 0.5)


def field(model: CameraModel) -> float:
    """How far from the axis the lens is valid: the largest tan(angle), for an equidistant lens the largest angle, rad.

    It is where the distorted radius first stops growing with the angle; infinite (equidistant: pi) where it never does.
    """
    if model.lens == "pinhole":
        return np.inf
    if model.lens == "equidistant":
        slope = np.polynomial.Polynomial(_angle_slope(model))
        return float(np.sqrt(_first_root(slope, np.pi**2)))
    above, below = (np.polynomial.Polynomial(part) for part in _radial(model))
    u = np.polynomial.Polynomial((0.0, 1.0))
    slope = above * below + 2.0 * u * (above.deriv() * below - above * below.deriv())
    return float(np.sqrt(min(_first_root(slope), _first_root(below))))


def undistorted(model: CameraModel) -> CameraModel:
    """A pinhole of the same focal lengths, centre and size."""
    return model.model_copy(update={"lens": "pinhole", "distortion": ()})


def _first_root(polynomial: np.polynomial.Polynomial, limit: float = np.inf) -> float:
    """The smallest positive real root, `limit` at most."""
    roots = polynomial.trim().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 0.0)]
    return float(min(real.min(initial=np.inf), limit))


# --- camera axes to the distorted plane at z = 1 ---------------------------------------------------------------------


def _onto_plane(model: CameraModel, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    if model.lens == "equidistant":
        return _by_angle(model, points)
    ahead = points[:, 2] > 0.0
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        straight = points[:, :2] / points[:, 2:]
        if model.lens == "pinhole":
            return straight, ahead
        valid = ahead & ((straight * straight).sum(axis=1) < (field(model) * _EDGE) ** 2)
        return _bent(model, straight), valid


def _by_angle(model: CameraModel, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    across = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(across, points[:, 2])
    bent = angle * _polynomial((1.0, *_angle_terms(model)), angle * angle)
    on_axis = across < 1e-12 * np.abs(points[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(on_axis, 0.0, bent / across)
    nowhere = (across == 0.0) & (points[:, 2] <= 0.0)
    return points[:, :2] * scale[:, None], (angle < field(model) * _EDGE) & ~nowhere


def _bent(model: CameraModel, straight: Floats) -> Floats:
    """What a radial-tangential lens makes of points of the plane."""
    p1, p2 = model.distortion[2:4]
    x, y = straight.T
    u = x * x + y * y
    above, below = _radial(model)
    radial = _polynomial(above, u) / _polynomial(below, u)
    return np.column_stack(
        (
            x * radial + 2.0 * p1 * x * y + p2 * (u + 2.0 * x * x),
            y * radial + p1 * (u + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    )


def _radial(model: CameraModel) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Coefficients of numerator and denominator of the radial factor, in powers of the squared radius."""
    k1, k2, _, _, k3, k4, k5, k6 = (*model.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
    return (1.0, k1, k2, k3), (1.0, k4, k5, k6)


def _angle_terms(model: CameraModel) -> tuple[float, ...]:
    return model.distortion or (0.0, 0.0, 0.0, 0.0)


def _angle_slope(model: CameraModel) -> tuple[float, ...]:
    """d(bent angle) / d(angle), in powers of the squared angle."""
    return (1.0, *((2 * i + 3) * k for i, k in enumerate(_angle_terms(model))))


def _polynomial(coefficients: tuple[float, ...], u: Floats) -> Floats:
    value = np.zeros_like(u)
    for c in reversed(coefficients):
        value = value * u + c
    return value


# --- and back --------------------------------------------------------------------------------------------------------


def _from_angles(model: CameraModel, plane: Floats) -> Floats:
    """Newton for the angle, started within the field, where the polynomial only grows."""
    bent = np.hypot(plane[:, 0], plane[:, 1])
    terms, slopes, limit = (1.0, *_angle_terms(model)), _angle_slope(model), field(model) * _EDGE
    angle = np.minimum(bent, 0.5 * limit)
    for _ in range(_STEPS):
        off = angle * _polynomial(terms, angle * angle) - bent
        slope = np.maximum(_polynomial(slopes, angle * angle), 1e-6)
        angle = np.clip(angle - off / slope, 0.0, limit)
        if _largest(off) * model.fx_px < _CLOSE_PX:
            break
    missed = ~(np.abs(angle * _polynomial(terms, angle * angle) - bent) * model.fx_px < 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = np.where(bent[:, None] > 0.0, plane / bent[:, None], 0.0) * np.sin(angle)[:, None]
    directions = np.column_stack((across, np.cos(angle)))
    directions[missed] = np.nan
    return directions


def _straightened(model: CameraModel, plane: Floats) -> Floats:
    """Newton for the point of the plane that the lens takes to `plane`."""
    limit = field(model) * _EDGE
    straight = _within(plane, 0.5 * limit)
    for _ in range(_STEPS):
        off = _bent(model, straight) - plane
        if _largest(off) * model.fx_px < _CLOSE_PX:
            break
        straight = _within(straight - _solved(_slopes(model, straight), off), limit)
    with np.errstate(invalid="ignore"):
        off = np.abs(_bent(model, straight) - plane).max(axis=1) * model.fx_px
    straight[~(off < 1e-9)] = np.nan
    return straight


def _largest(off: Floats) -> float:
    return float(np.nan_to_num(np.abs(off)).max(initial=0.0))


def _within(straight: Floats, limit: float) -> Floats:
    """Points pulled back onto a circle of radius `limit` where they lie beyond it."""
    if not np.isfinite(limit):
        return straight.copy()
    radius = np.hypot(straight[:, 0], straight[:, 1])
    return np.asarray(straight * (limit / np.maximum(radius, limit))[:, None])


def _slopes(model: CameraModel, straight: Floats) -> Floats:
    """Derivative (n, 2, 2) of `_bent`; symmetric, as the lens bends along radii but for the tangential terms."""
    p1, p2 = model.distortion[2:4]
    x, y = straight.T
    u = x * x + y * y
    above, below = _radial(model)
    n, d = _polynomial(above, u), _polynomial(below, u)
    dn, dd = (_polynomial((c[1], 2 * c[2], 3 * c[3]), u) for c in (above, below))
    radial, slope = n / d, (dn * d - n * dd) / (d * d)
    across = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    rows = (
        radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        across,
        across,
        radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )
    return np.stack(rows, axis=-1).reshape(-1, 2, 2)


def _solved(slopes: Floats, off: Floats) -> Floats:
    """Inverse of each 2 by 2 matrix times its vector, in closed form; zero where it has none."""
    a, b, c, d = slopes[:, 0, 0], slopes[:, 0, 1], slopes[:, 1, 0], slopes[:, 1, 1]
    determinant = a * d - b * c
    scale = np.where(np.abs(determinant) > 1e-9, 1.0 / np.where(determinant == 0.0, 1.0, determinant), 0.0)
    return np.column_stack((d * off[:, 0] - b * off[:, 1], a * off[:, 1] - c * off[:, 0])) * scale[:, None]
