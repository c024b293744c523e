"""Normalised information distance of steps in scans and steps in images, for a camera turned a little.

NID(X, Y) = 2 - (H(X) + H(Y)) / H(X, Y), from the joint histogram of both (Stewart, "Localisation using the appearance of
prior structure", Oxford 2015): 0 where one tells the other, 1 where they are unrelated, whatever the relation is.
Here X is what the scan says of two neighbouring rays (`steps.Kind`) and Y how much the grey differs between both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.camera_check.steps import Kind
from scanloom.stages.camera_check.views import View
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8, so3_exp

I8 = NDArray[np.int64]
F4 = NDArray[np.float32]
B1 = NDArray[np.bool_]
BINS = 12
"""Of differences of grey, the finer the smaller they are."""
STEP_RAD = 1e-4


@dataclass(frozen=True)
class Scene:
    """All views of a camera, ready to be compared again and again."""

    group: I8
    """Number of the view of each step."""
    groups: int
    kind: I8
    across: I8
    pixel: F8
    """(2, n, 2) of both places of each step, as calibrated or as turned by `at`."""
    slope: F8
    """(2, n, 2, 3): pixels per radian of turn about the camera's axes."""
    width: int
    height: int
    """Of all images, px."""
    grey: F4
    """All images one after the other, 0 to 1, so that each grey is as frequent in an image as any other."""

    def histograms(self, turn_rad: F8) -> F8:
        """Joint histograms (groups, across, kind, difference) for a camera turned by a small vector about its axes."""
        counts = np.zeros((self.groups, 2, len(Kind), BINS))
        turn = np.asarray(turn_rad, np.float64)
        _count(
            counts,
            self.group,
            self.across,
            self.kind,
            self.pixel,
            self.slope,
            turn,
            self.grey,
            self.width,
            self.height,
        )
        return counts


@kernel
def _count(
    counts: F8,
    group: I8,
    across: I8,
    kind: I8,
    pixel: F8,
    slope: F8,
    turn: F8,
    grey: F4,
    width: int,
    height: int,
) -> None:
    """Add every step to two bins beside each other, by how near it is to each."""
    for i in range(len(kind)):
        first = group[i] * width * height
        a = _grey(grey, first, width, pixel[0, i], slope[0, i], turn)
        b = _grey(grey, first, width, pixel[1, i], slope[1, i], turn)
        value = np.sqrt(abs(b - a)) * (BINS - 1)
        low = min(int(value), BINS - 2)
        share = value - low
        counts[group[i], across[i], kind[i], low] += 1.0 - share
        counts[group[i], across[i], kind[i], low + 1] += share


@kernel
def _grey(grey: F4, first: int, width: int, pixel: F8, slope: F8, turn: F8) -> float:
    """Bilinear, at a pixel moved by a turn."""
    u = max(pixel[0] + slope[0, 0] * turn[0] + slope[0, 1] * turn[1] + slope[0, 2] * turn[2], 0.0)
    v = max(pixel[1] + slope[1, 0] * turn[0] + slope[1, 1] * turn[1] + slope[1, 2] * turn[2], 0.0)
    column, row = int(u), int(v)
    a, b = u - column, v - row
    at = first + row * width + column
    above = grey[at] * (1.0 - a) + grey[at + 1] * a
    below = grey[at + width] * (1.0 - a) + grey[at + width + 1] * a
    value: float = above * (1.0 - b) + below * b
    return value


def nid(joint: F8) -> F8:
    """Distance of each joint histogram (..., across, kind, difference), given the direction: entropies are means over both,
    since two rows of a scan lie farther apart than two columns."""
    with np.errstate(invalid="ignore", divide="ignore"):
        both, kinds, steps = (
            _entropy(x) for x in (joint.reshape(*joint.shape[:-2], -1), joint.sum(-1), joint.sum(-2))
        )
        return np.asarray(2.0 - (kinds + steps).sum(axis=-1) / both.sum(axis=-1))


def _entropy(counts: F8) -> F8:
    """Of each histogram (..., cells), times what it counts."""
    total = counts.sum(axis=-1)
    logs = np.where(counts > 0, counts * np.log(np.where(counts > 0, counts, 1.0)), 0.0).sum(axis=-1)
    return np.asarray(np.where(total > 0, total * np.log(np.where(total > 0, total, 1.0)), 0.0) - logs)


def scene(views: list[View], grey: F4, *, margin_rad: float, at: F8, every: int = 1) -> Scene:
    """Views of one camera, and their `greys`, about the turn `at` (radians about its axes), of all steps or `every` second, third, ...

    Steps that a turn of `margin_rad` about each axis could take out of the image are left out, so that the same ones are
    compared whatever the turn."""
    model = views[0].model
    places, kind, across, number = gathered(views, every)
    ends = [_linear(model, xyz, at) for xyz in places]
    pixel, slope = np.stack([p for p, _ in ends]), np.stack([s for _, s in ends])
    with np.errstate(invalid="ignore"):
        reach = margin_rad * np.abs(slope).sum(axis=3)
        size = np.array([model.width_px, model.height_px])
        inner = ((pixel > reach) & (pixel < size - 2 - reach)).all(axis=(0, 2))
    return Scene(
        group=number[inner], groups=len(views), kind=kind[inner], across=across[inner],
        pixel=np.ascontiguousarray(pixel[:, inner]), slope=np.ascontiguousarray(slope[:, inner]),
        width=model.width_px, height=model.height_px, grey=grey,
    )  # fmt: skip


def gathered(views: list[View], every: int) -> tuple[list[F8], I8, I8, I8]:
    """Both places (n, 3) of all steps or of `every` second, third, ... of each view, their kinds, directions and views."""
    places = [np.concatenate([getattr(view, end)[::every] for view in views]) for end in ("near", "beside")]
    kind, across = (
        np.concatenate([getattr(view, of)[::every] for view in views]) for of in ("kind", "across")
    )
    number = np.repeat(np.arange(len(views), dtype=np.int64), [len(view.kind[::every]) for view in views])
    return places, kind, across, number


def greys(views: list[View], blur_px: float) -> F4:
    """All images one after the other, blurred, 0 to 1, each stretched so that its greys are evenly frequent."""
    return np.concatenate([_even(view.pixels, blur_px).ravel() for view in views])


def _linear(model: CameraModel, xyz: F8, at: F8) -> tuple[F8, F8]:
    """Pixels (n, 2) of places after the turn `at`, and their derivatives (n, 2, 3) by a further one; NaN where not seen."""
    turned = xyz @ so3_exp(at).T
    pixel, seen = project(model, turned)
    slope = np.empty((len(pixel), 2, 3))
    for axis in range(3):
        ahead = project(model, turned @ so3_exp(STEP_RAD * np.eye(3)[axis]).T)[0]
        slope[:, :, axis] = (ahead - pixel) / STEP_RAD
    pixel[~seen] = np.nan
    return pixel, slope


def _even(pixels: NDArray[np.uint8], blur_px: float) -> NDArray[np.float32]:
    """A picture stretched so that its greys are evenly frequent, 0 to 1, and blurred."""
    import cv2

    share = np.cumsum(np.bincount(pixels.ravel(), minlength=256)) / pixels.size
    middle = share - 0.5 * np.diff(share, prepend=0.0)
    stretched = middle.astype(np.float32)[pixels]
    return np.asarray(cv2.GaussianBlur(stretched, (0, 0), blur_px) if blur_px > 0 else stretched, np.float32)
