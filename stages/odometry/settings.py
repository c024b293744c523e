"""Settings of the odometry stage."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.degeneracy import Indicator
from scanloom.stages.geometry.se3 import F8


class Cutting(BaseModel):
    """Whether a session is cut into windows."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    windows: int = Field(
        0,
        ge=0,
        le=64,
        description="stretches a long session is cut into, tracked side by side by as many workers; 0 or 1: not cut",
    )
    window_overlap_s: float = Field(
        10.0, ge=1.0, le=300.0, description="how far a stretch reaches back into the one before it, s"
    )


class Settings(Cutting):
    """How scans are registered to the local map."""

    voxel_size_m: float = Field(
        1.0, ge=0.1, le=5.0, description="edge of a voxel of the local map, also the reach of the search, m"
    )
    points_per_voxel: int = Field(
        20, ge=4, le=100, description="most points kept in a voxel where windows are joined"
    )
    dense_voxel_size_m: float = Field(0.6, ge=0.1, le=5.0, description="the same where scans are dense, m")
    dense_source_voxel_m: float = Field(
        0.5, ge=0.05, le=10.0, description="what dense scans are thinned to before they are registered, m"
    )
    dense_map_spacing_m: float = Field(
        0.3, ge=0.02, le=5.0, description="what dense scans are thinned to before they enter the map, m"
    )
    dense_share: float = Field(
        0.145,
        ge=0.0,
        le=1.0,
        description="scans are dense when of the first one's points this share lies on a surface of 0.7 m",
    )
    map_spacing_m: float = Field(
        0.4, ge=0.02, le=5.0, description="scans are thinned to this before they enter the map, m"
    )
    source_voxel_m: float = Field(
        1.0, ge=0.05, le=10.0, description="scans are thinned to this before they are registered, m"
    )
    map_radius_m: float = Field(
        100.0, ge=10.0, le=1000.0, description="the local map is kept within this distance, m"
    )
    insert_m: float = Field(
        0.2, ge=0.0, le=10.0, description="way after which a scan enters the local map, m"
    )
    insert_rad: float = Field(
        0.05, ge=0.0, le=3.0, description="turn after which a scan enters the local map, rad"
    )
    keyframe_m: float = Field(1.0, ge=0.05, le=50.0, description="way between keyframes, m")
    keyframe_rad: float = Field(0.2, ge=0.01, le=3.0, description="turn between keyframes, rad")
    keyframe_s: float = Field(5.0, ge=0.1, le=1000.0, description="longest time between keyframes, s")
    max_iterations: int = Field(20, ge=1, le=200, description="most searches for partners per scan")
    first_deviation_m: float = Field(
        0.5, ge=0.01, le=10.0, description="expected error of the first prediction, m"
    )
    least_scale_m: float = Field(0.1, ge=0.01, le=5.0, description="smallest scale of the robust kernel, m")
    most_scale_m: float = Field(0.5, ge=0.01, le=10.0, description="largest scale of the robust kernel, m")
    least_inlier_ratio: float = Field(
        0.05, ge=0.0, le=1.0, description="registrations with a smaller share of inliers are not used"
    )
    least_bound_m: float = Field(
        1.0, ge=0.01, le=100.0, description="corrections up to this are always plausible, m"
    )
    bound_rad: float = Field(
        0.2, ge=0.01, le=3.2, description="largest plausible correction of rotation, rad"
    )
    least_p: float = Field(
        0.9,
        ge=0.0,
        le=1.0,
        description="directions observed with less probability are taken from the prediction; 0: the scan alone decides",
    )
    snr: float = Field(
        10.0,
        ge=0.0,
        le=1e4,
        description="a direction is observed when information exceeds that of noise this much",
    )
    measured_snr: float = Field(
        30.0,
        ge=0.0,
        le=1e4,
        description="the same where gyro and wheels tell the motion and a scan would overrule them",
    )
    indicator: Indicator = Field(
        "E1",
        description="form of E: worst deviation of translation (E1), rmse over inlier ratio (E2), E1 over inlier ratio (E3)",
    )
    residual: Literal["point_to_plane", "plane_to_plane"] = Field(
        "point_to_plane", description="what registration minimises"
    )
    point_noise_m: float = Field(0.02, ge=0.001, le=1.0, description="noise of a point, m")
    covariance_inflation: float = Field(
        0.6,
        ge=0.1,
        le=1000.0,
        description="factor on the covariance of a registration; below 1, for one scan repeats errors of the one before",
    )
    floor_m: float = Field(0.0005, ge=0.0, le=1.0, description="least standard deviation of translation, m")
    floor_rad: float = Field(0.00003, ge=0.0, le=0.1, description="least standard deviation of rotation, rad")

    @property
    def floor(self) -> F8:
        """Least covariance (6, 6) of a motion, (rad, m)."""
        return np.diag([self.floor_rad**2] * 3 + [self.floor_m**2] * 3)
