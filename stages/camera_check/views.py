"""What is compared: for each of a few dozen images the points of the scans around it, as the camera should see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera, CameraModel, Image, Images
from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels, PointClass
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.camera_check.steps import Kind, steps
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.pictures import decode, grey
from scanloom.stages.geometry.se3 import F8, inverse, transform
from scanloom.stages.geometry.shutter import Sweep, as_met

U1 = NDArray[np.uint8]
I8 = NDArray[np.int64]
WIDTH_PX = 640
"""Images are made smaller, to no less than this: half a degree stays several pixels."""
NEAR_M, FAR_M = 2.0, 60.0
"""Nearer the camera sees what the LiDAR beside it does not; further away a point covers much of the picture."""
CLEAR_M, LEAST_CLEAR = 6.0, 100
"""Nearer steps are left out where an image shows that many changes farther away: 3 mm by which a calibration misplaces a camera
turn what is seen at 3 m by 0.06 deg."""
CELLS = 160
"""Across the image, for telling what stands before what."""
BEHIND, BEHIND_M = 1.05, 0.3
"""A point so much further than the nearest in its cell or those around it may be hidden from the camera."""
STANDING = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)


@dataclass(frozen=True)
class View:
    """One image and the points that should be seen in it."""

    stamp_ns: int
    pixels: U1
    """Grey (h, w), made smaller."""
    model: CameraModel
    """Of the smaller image."""
    near: F8
    """(n, 3) in the camera's axes as calibrated, m; where a step begins."""
    beside: F8
    """(n, 3): where it ends."""
    kind: I8
    across: I8


@dataclass(frozen=True)
class Footing:
    """The scans of a session and where they stand."""

    deskewed: Sequence[Deskewed]
    labels: Sequence[Labels]
    stamp_ns: I8
    place: I8
    """(n, 2): chunk and number in it, of each scan."""
    path: Odometry


def footing(deskewed: Parts[Deskewed], labels: Parts[Labels], path: Odometry) -> Footing:
    """Where each scan lies, without reading one."""
    chunks = list(deskewed)
    rows = [
        (int(item["reference_ns"]), c, i)
        for c, chunk in enumerate(chunks)
        for i, item in enumerate(chunk.index)
    ]
    table = np.array(sorted(rows), np.int64).reshape(-1, 3)
    return Footing(chunks, list(labels), table[:, 0], table[:, 1:], path)


def moments(images: Parts[Images], camera: str, count: int) -> list[tuple[int, int, int]]:
    """(stamp, part, number) of `count` images of a camera, spread over the session."""
    found = [
        (int(item["stamp_ns"]), p, i)
        for p, part in enumerate(images)
        for i, item in enumerate(part.index)
        if item["camera"] == camera
    ]
    if len(found) <= count:
        return found
    return [found[i] for i in np.linspace(0, len(found) - 1, count).round().astype(int)]


def view(camera: Camera, image: Image, ground: Footing, scans: int, points: int) -> View | None:
    """The image with at most `points` points of the `scans` scans nearest in time; None where the path is not known."""
    nearest = _nearest(ground, image.stamp_ns, scans)
    if camera.T_lidar_camera is None or not len(nearest):
        return None
    try:
        pixels, model = smaller(grey(decode(image)), camera.model)
    except StageError:
        return None
    if pixels.shape != (model.height_px, model.width_px):
        return None
    T_odom_camera = _poses(camera, image, ground.path)
    sweep = Sweep.between(*T_odom_camera) if camera.readout_s > 0.0 else None
    seen = [_stepping(ground, k, inverse(T_odom_camera[1]), model, sweep) for k in nearest]
    near, beside, kind, across = (np.concatenate(column) for column in zip(*seen, strict=True))
    rows = _balanced(kind, np.linalg.norm(near, axis=1), points)
    return View(image.stamp_ns, pixels, model, near[rows], beside[rows], kind[rows], across[rows])


def _poses(camera: Camera, image: Image, path: Odometry) -> F8:
    """The camera (3, 4, 4) when its first, middle and last row were taken."""
    half_ns = round(0.5e9 * camera.readout_s)
    stamps = np.array([image.stamp_ns - half_ns, image.stamp_ns, image.stamp_ns + half_ns], np.int64)
    found = interpolate_poses(path.stamp_ns, path.T_odom_lidar, stamps) @ np.array(camera.T_lidar_camera)
    return np.asarray(found)


def _balanced(kind: I8, range_m: F8, count: int) -> I8:
    """Rows of `count` steps at most, as many of them where nothing changes as where something does; far ones if there are enough."""
    changes, clear = kind != Kind.EVEN, range_m > CLEAR_M
    use = clear if (changes & clear).sum() >= LEAST_CLEAR else np.ones(len(kind), bool)
    even, other = np.flatnonzero(~changes & use), np.flatnonzero(changes & use)
    wanted = min(len(even), len(other), count // 2)
    return np.sort(np.concatenate([_spread(rows, wanted) for rows in (even, other)]))


def _spread(rows: I8, count: int) -> I8:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), count)).astype(np.int64)] if len(rows) else rows


def smaller(pixels: U1, model: CameraModel) -> tuple[U1, CameraModel]:
    """An image and its model, both made smaller by a whole number."""
    import cv2

    step = max(pixels.shape[1] // WIDTH_PX, 1)
    height, width = pixels.shape[0] // step, pixels.shape[1] // step
    if step == 1:
        return pixels, model
    small = cv2.resize(pixels[: height * step, : width * step], (width, height), interpolation=cv2.INTER_AREA)
    changes = {
        "width_px": width, "height_px": height, "fx_px": model.fx_px / step, "fy_px": model.fy_px / step,
        "cx_px": (model.cx_px + 0.5) / step - 0.5, "cy_px": (model.cy_px + 0.5) / step - 0.5,
    }  # fmt: skip
    return np.asarray(small, np.uint8), model.model_copy(update=changes)


def visible(model: CameraModel, xyz: F8) -> I8:
    """Rows of the points in the image that nothing nearer hides, as far as the points themselves tell."""
    pixels, seen = project(model, xyz)
    far = np.linalg.norm(xyz, axis=1)
    rows = np.flatnonzero(seen & (far > NEAR_M) & (far < FAR_M))
    size = model.width_px / CELLS
    u, v = ((pixels[rows] + 0.5) / size).astype(np.int64).T
    down = int(model.height_px / size) + 1
    nearest = np.full((down + 2, CELLS + 3), np.inf)
    np.minimum.at(nearest, (v + 1, u + 1), far[rows])
    around = np.min(
        [nearest[1 + i : down + 1 + i, 1 + j : CELLS + 2 + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0
    )
    return np.asarray(rows[far[rows] < BEHIND * around[v, u] + BEHIND_M], np.int64)


def _nearest(ground: Footing, stamp_ns: int, scans: int) -> I8:
    """Scans of the same stretch of the path as the image; none where the path does not reach or is bridged."""
    path = ground.path
    if not len(ground.stamp_ns) or not inside(path.stamp_ns, _stamps(stamp_ns))[0]:
        return np.empty(0, np.int64)
    order = np.argsort(np.abs(ground.stamp_ns - stamp_ns), kind="stable")[:scans]
    row = np.searchsorted(path.stamp_ns, np.append(ground.stamp_ns[order], stamp_ns)).clip(0, len(path) - 1)
    whole = len(np.unique(path.segment[row])) == 1 and bool(path.reliable[row].all())
    return np.asarray(order[: len(order) if whole else 0], np.int64)


def _stepping(
    ground: Footing, k: int, T_camera_odom: F8, model: CameraModel, sweep: Sweep | None
) -> tuple[F8, F8, I8, I8]:
    """Steps between points of scan `k` that do not move, in the camera's axes at the time of the image."""
    chunk, number = ground.place[k]
    scan, labels = ground.deskewed[chunk][number], ground.labels[chunk][number]
    at = interpolate_poses(ground.path.stamp_ns, ground.path.T_odom_lidar, _stamps(scan.reference_ns))[0]
    found = steps(scan, np.isin(labels.class_, STANDING))
    near, beside = (transform(T_camera_odom @ at, xyz) for xyz in (found.near, found.beside))
    if sweep is not None:
        near, beside = (as_met(model, sweep, xyz) for xyz in (near, beside))
    rows = visible(model, near)
    return near[rows], beside[rows], found.kind[rows], found.across[rows]


def _stamps(stamp_ns: int) -> I8:
    return np.array([stamp_ns], np.int64)
