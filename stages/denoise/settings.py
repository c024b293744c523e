"""Settings of denoise."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

Corner = tuple[float, float, float]


class Settings(BaseModel):
    """Bounds of what counts as scenery."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_range_m: float = Field(2.0, ge=0.0, le=20.0, description="nearer points are out of range, m")
    max_range_m: float = Field(100.0, ge=1.0, le=1000.0, description="farther points are out of range, m")
    ego_low_m: Corner = Field(
        (-1.2, -1.0, 0.2),
        description="lower corner of the own vehicle in the base frame, m; default: a car on the ground",
    )
    ego_high_m: Corner = Field(
        (3.8, 1.0, 1.9),
        description="upper corner of the own vehicle in the base frame, m; it never reaches above the LiDAR",
    )
    outlier_neighbours: int = Field(
        2, ge=0, le=50, description="a point with fewer neighbours is an outlier, number; 0 keeps all"
    )
    outlier_radius_m: float = Field(
        0.2, ge=0.01, le=5.0, description="radius in which neighbours count, at least, m"
    )
    outlier_steps: float = Field(
        4.0,
        ge=0.5,
        le=20.0,
        description="radius in which neighbours count, in azimuth steps of the sensor, number",
    )
    ground_height_m: float = Field(
        0.15, ge=0.02, le=1.0, description="points less than this above the ground's height are ground, m"
    )
    particles: bool = Field(True, description="name what is in the air: dust, snow, rain, spray")
    moving: bool = Field(True, description="name what the scans shortly before or after see through")
