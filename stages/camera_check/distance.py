"""Normalised information distance of reflectance and grey, for a camera turned a little.

NID(X, Y) = 2 - (H(X) + H(Y)) / H(X, Y), from the joint histogram of both (Stewart, "Localisation using the appearance of
prior structure", Oxford 2015): 0 where one tells the other, 1 where they are unrelated, whatever the relation is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.camera_check.views import View
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, so3_exp

BINS = 16
BANDS = 6
"""Of range: reflectances are ranked among points about as far, since few sensors correct their readings for it."""
STEP_RAD = 1e-4


@dataclass(frozen=True)
class Scene:
    """All views of a camera, ready to be compared again and again."""

    group: NDArray[np.int64]
    """Which part of the session each point belongs to, from 0."""
    groups: int
    rank: NDArray[np.int64]
    """Bin of each point's reflectance."""
    pixel: F8
    """(n, 2), as calibrated or as turned by `at`."""
    slope: F8
    """(n, 2, 3): pixels per radian of turn about the camera's axes."""
    corner: NDArray[np.int64]
    """Where the image of each point begins in `grey`."""
    width: NDArray[np.int64]
    grey: NDArray[np.float32]
    """All images one after the other, 0 to BINS - 1, so that each grey is as frequent in an image as any other."""

    def histograms(self, turn_rad: F8) -> F8:
        """Joint histograms (groups, reflectance, grey) for a camera turned by a small vector about its axes."""
        uv = self.pixel + self.slope @ turn_rad
        u, v = np.maximum(uv[:, 0], 0.0), np.maximum(uv[:, 1], 0.0)
        column, row = u.astype(np.int64), v.astype(np.int64)
        a, b = u - column, v - row
        at = self.corner + row * self.width + column
        above = self.grey[at] * (1 - a) + self.grey[at + 1] * a
        below = self.grey[at + self.width] * (1 - a) + self.grey[at + self.width + 1] * a
        value = above * (1 - b) + below * b
        low = np.minimum(value.astype(np.int64), BINS - 2)
        share = value - low
        cell = (self.group * BINS + self.rank) * BINS + low
        size = self.groups * BINS * BINS
        counts = np.bincount(cell, 1.0 - share, size) + np.bincount(cell + 1, share, size)
        return np.asarray(counts.reshape(self.groups, BINS, BINS))


def nid(joint: F8) -> F8:
    """Distance of each joint histogram (..., BINS, BINS)."""
    total = joint.sum(axis=(-2, -1))
    with np.errstate(invalid="ignore", divide="ignore"):
        p = joint / total[..., None, None]
        both = _entropy(p.reshape(*p.shape[:-2], -1))
        return np.asarray(2.0 - (_entropy(p.sum(axis=-1)) + _entropy(p.sum(axis=-2))) / both)


def _entropy(p: F8) -> F8:
    return np.asarray(-np.where(p > 0, p * np.log(np.where(p > 0, p, 1.0)), 0.0).sum(axis=-1))


def scene(views: list[View], group: list[int], *, blur_px: float, margin_rad: float, at: F8) -> Scene:
    """Views about the turn `at` (radians about the camera's axes); points that a turn of `margin_rad` about each axis
    could take out of the image are left out, so that the same points are compared whatever the turn."""
    pictures = [_even(view.pixels, blur_px) for view in views]
    corners = np.concatenate(([0], np.cumsum([picture.size for picture in pictures])))
    parts = []
    for n, view in enumerate(views):
        pixel, slope = _linear(view, at)
        inner = np.isfinite(pixel).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
        size = np.array([view.model.width_px, view.model.height_px])
        reach = margin_rad * np.abs(slope).sum(axis=2)
        inner &= ((pixel > reach) & (pixel < size - 2 - reach)).all(axis=1)
        far = np.linalg.norm(view.points[inner], axis=1)
        parts.append((pixel[inner], slope[inner], view.intensity[inner], far, np.full(int(inner.sum()), n)))
    pixel, slope, intensity, far, of = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Scene(
        group=np.array(group, np.int64)[of], groups=max(group) + 1, rank=ranks(intensity, far), pixel=pixel, slope=slope,
        corner=corners[of], width=np.array([view.model.width_px for view in views], np.int64)[of],
        grey=np.concatenate([picture.ravel() for picture in pictures]),
    )  # fmt: skip


def _linear(view: View, at: F8) -> tuple[F8, F8]:
    """Pixels (n, 2) after the turn `at`, and their derivatives (n, 2, 3) by a further one."""
    turned = view.points @ so3_exp(at).T
    pixel, seen = project(view.model, turned)
    slope = np.empty((len(pixel), 2, 3))
    for axis in range(3):
        ahead = project(view.model, turned @ so3_exp(STEP_RAD * np.eye(3)[axis]).T)[0]
        back = project(view.model, turned @ so3_exp(-STEP_RAD * np.eye(3)[axis]).T)[0]
        slope[:, :, axis] = (ahead - back) / (2 * STEP_RAD)
    pixel[~seen] = np.nan
    return pixel, slope


def _even(pixels: NDArray[np.uint8], blur_px: float) -> NDArray[np.float32]:
    """A picture blurred, and stretched so that its greys are evenly frequent, 0 to BINS - 1."""
    import cv2

    soft = cv2.GaussianBlur(pixels, (0, 0), blur_px) if blur_px > 0 else pixels
    share = np.cumsum(np.bincount(soft.ravel(), minlength=256)) / soft.size
    middle = share - 0.5 * np.diff(share, prepend=0.0)
    return (middle * (BINS - 1)).astype(np.float32)[soft]


def ranks(intensity: NDArray[np.float32], far: F8) -> NDArray[np.int64]:
    """Reflectances (n,) as bins 0 to BINS - 1, each as full as any other, among points about as far."""
    out = np.zeros(len(far), np.int64)
    band = np.searchsorted(np.quantile(far, np.linspace(0, 1, BANDS + 1)[1:-1]), far) if len(far) else out
    for n in range(BANDS):
        rows = np.flatnonzero(band == n)
        values, inverse, counts = np.unique(intensity[rows], return_inverse=True, return_counts=True)
        middle = (np.cumsum(counts) - 0.5 * counts) / max(len(rows), 1)
        out[rows] = (middle * BINS).astype(np.int64).clip(0, BINS - 1)[inverse] if len(values) else 0
    return out
