"""Camera check: images held against the reflectance of the scans, without a target.

Points of what stands still are put into a few dozen images as the calibration says. Where a camera has been turned since, some
small turn makes grey and reflectance tell more of each other. It is searched for, with the images left out part by
part, and a camera is said to have moved when the turn is larger than a limit and clearly better for images that had no part in
finding it.
"""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import Agreement, Camera, CameraAgreement, CameraCheck, Cameras, Images
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.camera_check.search import Fit, best_turn
from scanloom.stages.camera_check.views import Footing, View, footing, moments, view

VERSION = 1
GROUPS = 8
"""Parts of the session that are left out in turn."""
LEAST_IMAGES, LEAST_POINTS = 8, 5000


class Settings(BaseModel):
    """How thoroughly the cameras are checked, and what counts as moved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    images: int = Field(
        default=40,
        ge=0,
        le=1000,
        description="images of each camera that are looked at; 0 for no check, number",
    )
    scans: int = Field(
        default=3, ge=1, le=50, description="scans around an image whose points are used, number"
    )
    points: int = Field(
        default=4000, ge=100, le=1_000_000, description="points that are used of each image at most, number"
    )
    moved_deg: float = Field(
        default=0.25, ge=0.01, le=2.0, description="turn from which on a camera has moved, deg"
    )
    sure: float = Field(
        default=3.0, ge=1.0, le=20.0,
        description="standard deviations by which a turn must fit better, and be larger than nothing, to count",
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
    return CameraCheck(cameras=tuple(each.model_copy(update={"remark": _sentence(each)}) for each in found))


def check_camera(
    settings: Settings, camera: Camera, images: Parts[Images], ground: Footing
) -> CameraAgreement:
    """One camera; `unknown` where too little was seen."""
    parts = list(images)
    views: list[View] = []
    for _, part, number in moments(images, camera.name, settings.images):
        seen = view(camera, parts[part][number], ground, settings.scans, settings.points)
        if seen is not None and len(seen.points):
            views.append(seen)
    points = sum(len(seen.points) for seen in views)
    if len(views) < LEAST_IMAGES or points < LEAST_POINTS:
        return CameraAgreement(camera=camera.name, images=len(views), points=points)
    fit = best_turn(views, [n * GROUPS // len(views) for n in range(len(views))])
    # points move by the turn where the camera moved by its inverse
    offset, std = np.degrees(-fit.turn_rad), np.degrees(fit.std_rad)
    return CameraAgreement(
        camera=camera.name, verdict=judged(settings, fit), images=len(views), points=fit.points, nid=fit.nid,
        nid_best=fit.nid_best, offset_deg=(float(offset[0]), float(offset[1]), float(offset[2])),
        std_deg=(float(std[0]), float(std[1]), float(std[2])),
    )  # fmt: skip


def judged(settings: Settings, fit: Fit) -> Agreement:
    """Moved: far enough, and beyond doubt. Agrees: not far, and known well enough to say so."""
    size = float(np.degrees(np.linalg.norm(fit.turn_rad)))
    along = fit.turn_rad / max(float(np.linalg.norm(fit.turn_rad)), 1e-12)
    std = float(np.degrees(np.linalg.norm(fit.std_rad * along)))
    clear = fit.gain_std > settings.sure and size > settings.sure * std
    if size > settings.moved_deg:
        return "moved" if clear else "unknown"
    return "agrees" if float(np.degrees(fit.std_rad).max()) < settings.doubt_deg else "unknown"


def _sentence(found: CameraAgreement) -> str:
    if found.verdict == "moved":
        return (
            f"Camera {found.camera} has turned by {found.turned_deg:.2f} deg since its calibration, by "
            f"{found.images} images held against the reflectance: calibrate it again."
        )
    if found.verdict == "agrees":
        return f"Camera {found.camera} stands where its calibration says, to {found.turned_deg:.2f} deg."
    return f"Whether camera {found.camera} stands where its calibration says cannot be told from {found.images} images."
