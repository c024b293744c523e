"""Settings of the gates and weights of GNSS."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class GnssSettings(BaseModel):
    """Gates and weights of GNSS positions."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_sigma_m: float = Field(
        default=5.0,
        gt=0,
        le=100,
        description="fixes with a larger horizontal standard deviation are left out, m",
    )
    unknown_sigma_m: float = Field(
        default=3.0,
        gt=0,
        le=100,
        description="horizontal standard deviation where the receiver gives none, m",
    )
    min_sigma_m: float = Field(
        default=0.05, gt=0, le=10, description="smallest horizontal standard deviation that is believed, m"
    )
    inflation: float = Field(
        default=2.0, ge=1, le=10, description="factor on standard deviations; fixes share errors over time"
    )
    min_satellites: int = Field(
        default=0, ge=0, le=50, description="fewer satellites: left out; logs that do not tell pass"
    )
    outage_s: float = Field(
        default=2.0, gt=0, le=600, description="a pause this long without good fixes is an outage, s"
    )
    recovery_s: float = Field(
        default=5.0, ge=0, le=600, description="good fixes needed after an outage before one is used, s"
    )
    recovery_sigma_m: float = Field(
        default=2.0,
        ge=0,
        le=100,
        description="standard deviation to add right after an outage, fading with recovery_s as its time constant, m",
    )
    max_clock_offset_s: float = Field(
        default=20.0,
        ge=0,
        le=120,
        description="largest offset of the receiver's clock that is looked for and corrected (leap seconds: 18), s",
    )
    motion_tolerance_m: float = Field(
        default=0.3, gt=0, le=10, description="disagreement with odometry always allowed, m"
    )
    motion_drift: float = Field(
        default=0.02, gt=0, le=1, description="disagreement with odometry allowed per metre driven"
    )
    height_tolerance_m: float = Field(
        default=1.0, gt=0, le=100, description="jump of the height against odometry's always allowed, m"
    )
    height_drift: float = Field(
        default=0.1, gt=0, le=1, description="change of height against odometry's allowed per metre driven"
    )
    chain_m: float = Field(
        default=400.0, gt=10, le=1e5, description="farthest path over which two fixes are compared, m"
    )
    min_agreeing: float = Field(
        default=0.5,
        ge=0,
        le=1,
        description="smaller share of the way on which fixes agree with odometry: GNSS of the session is not used",
    )
    walk_factor: float = Field(
        default=4.0,
        ge=1,
        le=100,
        description="by how much fixes may show odometry's random walk to be smaller or larger than set; 1: as set",
    )
    spacing_m: float = Field(default=5.0, ge=0, le=1000, description="one fix is used per this much path, m")
    max_heading_sigma_deg: float = Field(
        default=8.0, gt=0, le=90, description="heading less certain than this: no georeference, deg"
    )
