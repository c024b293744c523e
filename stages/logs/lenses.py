"""Camera models from the many ways in which they are written down."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from scanloom.schemas.cameras import CameraModel, Lens
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.logs.records import CameraInfo

_NAMES: dict[str, Lens] = {
    "plumb_bob": "radial-tangential",
    "rational_polynomial": "radial-tangential",
    "radtan": "radial-tangential",
    "radial-tangential": "radial-tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "kannalabrandt4": "equidistant",
    "pinhole": "pinhole",
    "none": "pinhole",
}
_KNOWN = "plumb_bob, rational_polynomial, radtan, equidistant, fisheye or none"
_SHAPE = 0.01
"""Images whose sides differ from the calibrated ones by the same factor, within this share, were scaled as a whole."""


def camera_model(name: str, K: F8, distortion: Sequence[float], size_px: tuple[int, int]) -> CameraModel:
    """A model of its parts.

    Parameters
    ----------
    name : of the lens, as ROS, Kalibr or OpenCV call it; empty for what the coefficients suggest.
    K : (3, 3) camera matrix, px.
    distortion : coefficients in OpenCV's order; more than a lens has are allowed when they are zero.
    size_px : width and height.

    Raises
    ------
    ValueError : a sentence that says what is wrong.
    """
    numbers = [*np.ravel(K).tolist(), *distortion]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("its numbers are not finite")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError("its camera matrix is empty, the camera was never calibrated")
    if min(size_px) <= 0:
        raise ValueError("it does not say how large the image is")
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise ValueError(f"its camera matrix has a skew of {K[0, 1]:g} px, which no lens here has")
    lens, kept = _lens(name, tuple(float(d) for d in distortion))
    return CameraModel(
        lens=lens, width_px=size_px[0], height_px=size_px[1], fx_px=float(K[0, 0]), fy_px=float(K[1, 1]),
        cx_px=float(K[0, 2]), cy_px=float(K[1, 2]), distortion=kept,
    )  # fmt: skip


def _lens(name: str, distortion: tuple[float, ...]) -> tuple[Lens, tuple[float, ...]]:
    key = name.strip().lower()
    if key and key not in _NAMES:
        raise ValueError(f"its lens is called {name!r}, which is unknown; known are {_KNOWN}")
    lens: Lens = _NAMES.get(key, "radial-tangential")
    if not any(distortion):
        return ("equidistant", (0.0,) * 4) if lens == "equidistant" else ("pinhole", ())
    if lens == "pinhole":
        raise ValueError("it is said to have no distortion, and distortion coefficients all the same")
    lengths = (4,) if lens == "equidistant" else (4, 5, 8)
    least = max(i + 1 for i, d in enumerate(distortion) if d)
    fitting = [n for n in lengths if n >= least]
    if not fitting:
        raise ValueError(f"its {len(distortion)} distortion coefficients are more than a {lens} lens has")
    n = len(distortion) if len(distortion) in fitting else fitting[0]
    return lens, (*distortion, *(0.0,) * n)[:n]


def model_of_info(info: CameraInfo, *, rectified: bool) -> CameraModel:
    """The model a camera info describes, of the image as it is recorded (binned and cut as the message says).

    Parameters
    ----------
    rectified : the images are straightened already: they have the pinhole of `P`.

    Raises
    ------
    ValueError : a sentence that says what is wrong.
    """
    K = np.array(info.P).reshape(3, 4)[:, :3] if rectified and any(info.P) else np.array(info.K).reshape(3, 3)
    K = K.copy()
    # as image_geometry of ROS has it
    K[:2, 2] -= info.offset_px
    K[:2] /= np.maximum(np.array(info.binning, float), 1.0)[:, None]
    size = (info.width // max(info.binning[0], 1), info.height // max(info.binning[1], 1))
    return camera_model("" if rectified else info.lens, K, () if rectified else info.distortion, size)


def resized(model: CameraModel, width_px: int, height_px: int) -> CameraModel | None:
    """The model of the same images scaled to another size; None when the shapes differ."""
    across, down = width_px / model.width_px, height_px / model.height_px
    if abs(across / down - 1.0) > _SHAPE:
        return None
    # pixel centres: the outer edges of the image, half a pixel further out, are what scales
    return model.model_copy(
        update={
            "width_px": width_px,
            "height_px": height_px,
            "fx_px": model.fx_px * across,
            "fy_px": model.fy_px * down,
            "cx_px": (model.cx_px + 0.5) * across - 0.5,
            "cy_px": (model.cy_px + 0.5) * down - 0.5,
        }
    )
