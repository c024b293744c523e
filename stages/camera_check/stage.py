"""Camera check: images held against the steps of reflectance and range in the scans, without a target.

Neighbouring points of what stands still are put into a few dozen images as the calibration says. Where a camera has been
turned since, some small turn makes the steps of grey and those of the scans tell more of each other. It is searched for, its
scatter is found by drawing images again and from their halves, and a camera is said to have moved when the turn is larger than a limit, beyond
doubt, and clearly better than none. Where that search ends far from none or in doubt, others begin on a grid of large turns.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import Agreement, Camera, CameraAgreement, CameraCheck, Cameras, Image, Images
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.camera_check.far import GRID_RAD, GRID_STEPS, farther
from scanloom.stages.camera_check.search import Fit, best_turn, comparable
from scanloom.stages.camera_check.views import Footing, View, footing, moments, view
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from scanloom.stages.logs.mounting import as_matrix4

VERSION = 6
LEAST_IMAGES, LEAST_POINTS = 8, 2000
LEAST_GAIN_STD = 1.5
"""Standard deviations by which a turn must fit images better than none that had no part in finding it."""
LARGE_RAD, LARGE_TELLS = np.radians(1.0), 2.5
"""So far from where it fits a calibration tells little of the images: a turn as large that is not known well fits by chance, unless it
tells of them that many times as much."""


class Settings(BaseModel):
    """How thoroughly the cameras are checked, and what counts as moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: int = Field(
        default=60,
        ge=0,
        le=1000,
        description="images of each camera that are looked at; 0 for no check, number",
    )
    scans: int = Field(
        default=1, ge=1, le=50, description="scans nearest in time to an image that are used, number"
    )
    points: int = Field(
        default=1200,
        ge=100,
        le=1_000_000,
        description="pairs of neighbouring points that are used of each image at most, number",
    )
    moved_deg: float = Field(
        default=0.25, ge=0.01, le=2.0, description="turn from which on a camera has moved, deg"
    )
    sure: float = Field(
        default=3.0, ge=1.0, le=20.0,
        description="standard deviations by which a turn must be larger than nothing to count",
    )  # fmt: skip
    doubt_deg: float = Field(
        default=0.12, ge=0.01, le=2.0,
        description="largest standard deviation of the turn with which a camera can be said to agree, deg",
    )  # fmt: skip


def camera_check(
    settings: Settings,
    images: Parts[Images],
    cameras: Cameras,
    deskewed: Parts[Deskewed],
    labels: Parts[Labels],
    odometry: Odometry,
) -> CameraCheck:
    """Say of every camera whether it stands where its calibration says. Nothing is read where there are no images."""
    placed = [camera for camera in cameras.cameras if camera.T_lidar_camera is not None]
    if not placed or not len(images) or settings.images == 0:
        return CameraCheck()
    ground = footing(deskewed, labels, odometry)
    found = [check_camera(settings, camera, images, ground) for camera in placed]
    return CameraCheck(
        cameras=tuple(each.model_copy(update={"remark": _sentence(settings, each)}) for each in found)
    )


def check_camera(
    settings: Settings, camera: Camera, images: Parts[Images], ground: Footing
) -> CameraAgreement:
    """One camera; `unknown` where too little was seen."""
    parts = list(images)
    looked = [parts[part][number] for _, part, number in moments(images, camera.name, settings.images)]
    views = [each for each in _views(settings, camera, looked, ground) if len(each.kind)]
    points = comparable(views) if views else 0
    if len(views) < LEAST_IMAGES or points < LEAST_POINTS:
        return CameraAgreement(camera=camera.name, images=len(views), points=points)
    fit = best_turn(views)
    if judged(settings, fit) == "unknown" or fit.size_rad > LARGE_RAD:
        stamps = {each.stamp_ns for each in views}
        used = [image for image in looked if image.stamp_ns in stamps]
        fit = farther(
            views, fit, lambda turn: _views(settings, _turned(camera, turn), used, ground), np.radians(settings.doubt_deg)
        )  # fmt: skip
    # points move by the turn where the camera moved by its inverse
    offset, std = np.degrees(-fit.turn_rad), np.degrees(fit.std_rad)
    return CameraAgreement(
        camera=camera.name, verdict=judged(settings, fit), images=len(views), points=fit.points, nid=fit.nid,
        nid_best=fit.nid_best, offset_deg=(float(offset[0]), float(offset[1]), float(offset[2])),
        std_deg=(float(std[0]), float(std[1]), float(std[2])),
    )  # fmt: skip


def _views(settings: Settings, camera: Camera, images: list[Image], ground: Footing) -> list[View]:
    """Of the images that can be used; some may show nothing of the scans."""
    seen = (view(camera, image, ground, settings.scans, settings.points) for image in images)
    return [each for each in seen if each is not None]


def _turned(camera: Camera, turn_rad: F8) -> Camera:
    """The camera for which points are turned by a vector about its axes."""
    T = np.array(camera.T_lidar_camera) @ pose(so3_exp(-turn_rad), np.zeros(3))
    return camera.model_copy(update={"T_lidar_camera": as_matrix4(T)})


def judged(settings: Settings, fit: Fit) -> Agreement:
    """Moved: far enough, and beyond doubt. Agrees: not far, a standard deviation more included, and known well enough."""
    size = float(np.degrees(fit.size_rad))
    known = float(np.degrees(fit.std_rad).max()) < settings.doubt_deg
    telling = known or 1.0 - fit.nid_best > LARGE_TELLS * (1.0 - fit.nid)
    if fit.held or (fit.size_rad > LARGE_RAD and not telling):
        return "unknown"
    along = fit.turn_rad / max(fit.size_rad, 1e-12)
    std = float(np.degrees(np.linalg.norm(fit.std_rad * along)))
    clear = fit.gain_std > LEAST_GAIN_STD and size > settings.sure * std
    if size > settings.moved_deg:
        return "moved" if clear else "unknown"
    return "agrees" if known and size + std < settings.moved_deg else "unknown"


def _sentence(settings: Settings, found: CameraAgreement) -> str:
    if found.verdict == "moved":
        return (
            f"Camera {found.camera} has turned by {found.turned_deg:.2f} deg since its calibration, by "
            f"{found.images} images held against the scans: calibrate it again."
        )
    if found.verdict == "agrees":
        return f"Camera {found.camera} stands where its calibration says, to {found.turned_deg:.2f} deg."
    return (
        f"Whether camera {found.camera} stands where its calibration says cannot be told from {found.images} images: "
        f"{_doubt(settings, found)}."
    )


def _doubt(settings: Settings, found: CameraAgreement) -> str:
    """Why it cannot be told."""
    if not np.isfinite(found.nid):
        return f"{found.points} pairs of points were seen in them; {LEAST_IMAGES} images and {LEAST_POINTS} pairs are the least"
    if found.turned_deg > np.degrees(LARGE_RAD):
        return (
            f"they fit the scans well at no turn that was tried, up to {np.degrees(GRID_STEPS * GRID_RAD):.0f} deg about each axis; "
            "it may have turned farther, or the calibration may be another camera's"
        )
    if found.turned_deg > settings.moved_deg:
        return f"a turn of {found.turned_deg:.2f} deg would fit best, but not clearly better than none"
    if max(found.std_deg) < settings.doubt_deg:
        return (
            f"its turn of {found.turned_deg:.2f} deg is too near to the limit of {settings.moved_deg:.2f} deg"
        )
    return f"its turn is known to {max(found.std_deg):.2f} deg only"
