"""The calibration: where the cameras stand on the LiDAR, how sure that is, and what it rests on."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict

from scanloom.schemas.cameras import Camera
from scanloom.schemas.product import Document

Matrix6 = tuple[tuple[float, float, float, float, float, float], ...]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Certainty(_Entry):
    """How well the pose of one camera is known."""

    camera: str
    covariance: Matrix6
    """Of the right tangent (rotation, translation) of `T_lidar_camera`, rad and m: axes of the camera."""
    rotation_sigma_deg: tuple[float, float, float]
    """About the camera's x (right), y (down), z (forward); one standard deviation."""
    translation_sigma_m: tuple[float, float, float]
    """Along the camera's x, y, z; one standard deviation."""
    scale: float
    """Factor that the residuals put on the standard deviations; 1 when they are as expected."""
    weakest: str
    """The direction that is known worst, in words."""
    advice: str
    """Which placement would help most, in words."""
    placements: int
    """Placements in use that this camera saw."""
    residual_px: float
    """Root mean square distance of the corners from the LiDAR's boards, by the calibration of all placements."""
    leave_one_out_px: float
    """The same, each placement by a calibration without it; what the LiDAR is off by is corrected."""
    leave_one_out_cm: float
    """The same on the board's plane: from each corner's ray to the LiDAR's corner."""
    leave_one_out_as_read_px: float
    """With boards where their clouds alone have them: what points straight from the sensor meet."""
    leave_one_out_as_read_cm: float


class Sighting(_Entry):
    """One board in one placement, as one camera and the LiDAR saw it."""

    camera: str
    used: bool
    reason: str = ""
    """Why it was left out."""
    corners: int = 0
    corner_sigma_px: float = 0.0
    """Scatter of the corners about the best flat board in this image alone."""
    residual_px: float | None = None
    """Root mean square distance of the corners from the LiDAR's board, by the final calibration."""
    leave_one_out_px: float | None = None
    leave_one_out_cm: float | None = None


class Placement(_Entry):
    """One place where the board stood."""

    name: str
    used: bool
    reason: str = ""
    """Why it was left out."""
    distance_m: float | None = None
    """From the LiDAR to the board."""
    tilt_deg: float | None = None
    """Between the board's normal and the line of sight of the LiDAR."""
    board_points: int = 0
    edge_points: int = 0
    T_lidar_board: tuple[tuple[float, float, float, float], ...] | None = None
    """The board where the graph has it."""
    sightings: tuple[Sighting, ...] = ()


class Repeatability(_Entry):
    """How calibrations from random halves of the placements differ from each other, camera by camera."""

    camera: str
    halves: int
    rotation_max_deg: float
    """Largest angle between the calibration of a half and the mean of all halves."""
    translation_max_m: float
    rotation_rms_deg: float
    translation_rms_m: float
    held_out_px: float | None = None
    """Root mean square over the placements that a half did not hold."""
    held_out_cm: float | None = None


class Calibration(Document):
    """Cameras on a LiDAR, found from boards; `cameras` are as a session takes them."""

    NAME: ClassVar[str] = "calibration"

    cameras: tuple[Camera, ...]
    method: Literal["board", "paper"]
    """`board`: one board pose per placement, LiDAR factors; `paper`: free corner points, reprojection only."""
    verdict: Literal["good", "doubtful"]
    reason: str
    """Why, in a sentence."""
    certainty: tuple[Certainty, ...]
    placements: tuple[Placement, ...]
    repeatability: tuple[Repeatability, ...] = ()
    remarks: tuple[str, ...] = ()
    """What was found odd, in sentences."""
