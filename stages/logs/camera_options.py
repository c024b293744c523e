"""Settings of images: which cameras, how many of their images, and what the log does not say of them."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from pydantic.functional_validators import AfterValidator

from scanloom.schemas.cameras import CameraModel
from scanloom.schemas.session import Matrix4

_TOLERANCE = 1e-3


def rigid(T: Matrix4 | None) -> Matrix4 | None:
    """The same matrix if it is a pose. Raises ValueError when it is none."""
    if T is None:
        return None
    M = np.array(T, float)
    if M.shape != (4, 4) or not np.isfinite(M).all():
        raise ValueError("T_lidar_camera must be a 4x4 matrix of numbers")
    R = M[:3, :3]
    turned = np.abs(R @ R.T - np.eye(3)).max() < _TOLERANCE and np.linalg.det(R) > 0
    if not turned or np.abs(M[3] - (0, 0, 0, 1)).max() > _TOLERANCE:
        raise ValueError(
            "T_lidar_camera is no pose: its upper left 3x4 must hold a rotation and a translation"
        )
    return T


class GivenCamera(BaseModel):
    """What the user says of a camera; what is left out comes from the log."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9._-]*$")
    topic: str = ""
    """Empty: the topic whose name gives this camera's name; `none` leaves the camera out."""
    model: CameraModel | None = None
    T_lidar_camera: Annotated[Matrix4 | None, AfterValidator(rigid)] = None
    clock_offset_s: float = Field(default=0.0, ge=-1e10, le=1e10)
    readout_s: float = Field(default=0.0, ge=0.0, le=1.0)
    source: str = "session file"
    remark: str = ""
    """What its file leaves open or doubts, in a sentence."""


class Settings(BaseModel):
    """Which cameras, how many of their images."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    use: Literal["all", "given", "none"] = Field(
        default="all", description="cameras of the log: all, those of `cameras` only, or none"
    )
    cameras: tuple[GivenCamera, ...] = Field(
        default=(), description="what the log does not say of its cameras; from the session file as a rule"
    )
    spacing_s: float = Field(
        default=0.5,
        ge=0.0,
        le=3600.0,
        description="least time between two images of a camera that are kept, s",
    )
    chunk_s: float = Field(default=20.0, ge=1.0, le=600.0, description="length of a part of the images, s")
    stamp_source: Literal["header", "receive"] = Field(
        default="header", description="stamps of the images, or the times of recording"
    )
    align_clocks: bool = Field(
        default=True,
        description="shift a camera whose clock differs from the LiDAR's by more than a second, using receive times",
    )
