"""How a rig is calibrated."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class CalibrateSettings(BaseModel):
    """What is estimated, what counts as a stranger, and when a calibration is called good."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Literal["board", "paper"] = Field(
        default="board",
        description="board: one pose per board, clouds as factors; paper: free corner points, images only",
    )
    start: Literal["epnp", "given"] = Field(
        default="epnp",
        description="epnp: from the boards; given: the poses in the camera files, where these hold some",
    )
    corner_least_px: float = Field(
        default=0.1, ge=0.01, le=5.0, description="corners are never believed better than this, one sigma, px"
    )
    lidar: Literal["estimated", "believed"] = Field(
        default="estimated",
        description="estimated: what all clouds of the sensor are off by is found along; believed: it is off in nothing",
    )
    beam_offset_m: float = Field(
        default=0.01,
        ge=0.0,
        le=0.1,
        description="by how much each beam's ranges may be off, one sigma, m; 0 believes them",
    )
    lens_share: float = Field(
        default=0.0,
        ge=0.0,
        le=0.05,
        description="how far focal lengths and centre may be from what was given, one sigma, as a share of the focal length; 0 keeps them",
    )
    lens_bend_px: float = Field(
        default=0.0,
        ge=0.0,
        le=50.0,
        description="how far each coefficient of the lens may be from what was given, one sigma, px at a corner of the image; 0 keeps them",
    )
    scatter_px: float = Field(
        default=1.0,
        ge=0.1,
        le=20.0,
        description="images whose corners scatter more about a flat board are left out, px",
    )
    stranger: float = Field(
        default=5.0,
        ge=2.0,
        le=100.0,
        description="chi-square over its freedom from which a board is left out, number",
    )
    halves: int = Field(
        default=10, ge=0, le=100, description="random halves of the placements for repeatability, number"
    )
    seed: int = Field(default=0, ge=0, le=2**31, description="seed of the halves")
    good_px: float = Field(
        default=4.0, ge=0.1, le=50.0, description="leave-one-out error of a good calibration, px"
    )
    good_cm: float = Field(
        default=1.0, ge=0.1, le=20.0, description="leave-one-out error on the board of a good calibration, cm"
    )
    good_deg: float = Field(
        default=0.3,
        ge=0.01,
        le=5.0,
        description="halves of a good calibration turn from their mean by less than this, degrees",
    )
    good_m: float = Field(
        default=0.03,
        ge=0.001,
        le=0.5,
        description="halves of a good calibration shift from their mean by less than this, m",
    )
