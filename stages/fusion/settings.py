"""Settings of the fusion stage."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.fusion.consistency import ConsistencySettings
from scanloom.stages.fusion.gnss import GnssSettings


class WheelSettings(BaseModel):
    """How far gyro and wheels are trusted between keyframes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rotation_deg_sqrt_m: float = Field(
        default=0.03, gt=0, le=10, description="random walk of the turn per root of way, deg/sqrt(m)"
    )
    rotation_deg_sqrt_s: float = Field(
        default=0.1, gt=0, le=10, description="random walk of the gyro per root of time, deg/sqrt(s)"
    )
    translation_m_sqrt_m: float = Field(
        default=0.05,
        gt=0,
        le=10,
        description="random walk of the way per root of way, m/sqrt(m); errors of scale last long, so it is generous",
    )


class Settings(BaseModel):
    """How far each kind of measurement is trusted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    odometry_rotation_deg_sqrt_m: float = Field(
        default=0.05,
        gt=0,
        le=10,
        description="random walk of odometry's rotation added per root of distance, deg/sqrt(m)",
    )
    odometry_translation_m_sqrt_m: float = Field(
        default=0.02,
        gt=0,
        le=10,
        description="random walk of odometry's translation added per root of distance, m/sqrt(m)",
    )
    covariance: Literal["aware", "fixed"] = Field(
        default="aware",
        description="aware: directions that a registration did not see carry next to no weight, so that wheels and GNSS "
        "decide there; fixed: every step of odometry weighs the same and wheels are not asked (for comparison)",
    )
    wheel: WheelSettings = Field(default_factory=WheelSettings, description="trust in gyro and wheels")
    gravity_sigma_deg: float = Field(
        default=1.5, gt=0, le=45, description="standard deviation of a measured up direction, deg"
    )
    assumed_level_sigma_deg: float = Field(
        default=4.0,
        gt=0,
        le=45,
        description="standard deviation of `the vehicle stands level` when there is no IMU, deg",
    )
    gravity_spacing_m: float = Field(
        default=10.0, gt=0, le=1000, description="one gravity factor per this much path, m"
    )
    loop_inflation: float = Field(
        default=1.0, ge=0.1, le=100, description="factor on the standard deviations of loops"
    )
    inlier_probability: float = Field(
        default=0.999,
        gt=0.5,
        lt=1,
        description="chi-square probability up to which a loop or fix is an inlier",
    )
    extension: Literal["rigid", "soft"] = Field(
        default="rigid",
        description="of a map that is extended: rigid keeps the poses it has; soft lets them give way to new loops",
    )
    extension_deadband_m: float = Field(
        default=0.02,
        ge=0,
        le=1,
        description="soft: stretches of the map that move by less stay as they are, and so do their tiles, m",
    )
    consistency: ConsistencySettings = Field(
        default_factory=ConsistencySettings,
        description="how loops must agree with each other and with the rest",
    )
    gnss: GnssSettings = Field(default_factory=GnssSettings, description="gates and weights of GNSS")
