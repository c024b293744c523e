"""Settings of change detection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

F8 = NDArray[np.float64]
I4 = NDArray[np.int32]


class Settings(BaseModel):
    """When a point of the old map counts as gone."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_range_m: float = Field(
        30.0, ge=5.0, le=200.0, description="scans say nothing of points farther away, m"
    )
    thinning_m: float = Field(
        0.2, ge=0.05, le=2.0, description="one point of the old map is asked per voxel of this edge, m"
    )
    clearance_m: float = Field(
        0.3,
        ge=0.0,
        le=5.0,
        description="points less than this above the lowest one around them are not asked, m",
    )
    margin_m: float = Field(
        0.5, ge=0.05, le=5.0, description="a ray passed when it ended by so much behind the point, m"
    )
    margin_share: float = Field(0.02, ge=0.0, le=0.5, description="more of it per metre of range")
    ray_m: float = Field(
        0.2, ge=0.02, le=2.0, description="a ray must pass this near to say that nothing is there, m"
    )
    guard_m: float = Field(
        0.4,
        ge=0.05,
        le=5.0,
        description="a ray that ends before or at the point within this distance of its line of sight leaves it open, m",
    )
    confirm_m: float = Field(
        0.3, ge=0.02, le=2.0, description="a return this near says that it is still there, m"
    )
    min_scans: int = Field(3, ge=1, le=1000, description="scans that must have seen through a point")
    max_confirming: float = Field(
        0.25,
        ge=0.0,
        le=1.0,
        description="confirming scans, as a share of those that saw through, up to which it is gone",
    )
    max_through_before: float = Field(
        0.25,
        ge=0.0,
        le=1.0,
        description="scans of the old sessions that saw through, as a share of those that confirmed, up to which it stood then",
    )
    link_m: float = Field(
        0.6, ge=0.1, le=5.0, description="points nearer to each other than this are one object, m"
    )
    min_points: int = Field(12, ge=1, le=10_000, description="points an object needs to be reported")

    def limits(self) -> F8:
        """What `rays.judge` asks for."""
        return np.array(
            [self.max_range_m, self.margin_m, self.margin_share, self.ray_m, self.guard_m, self.confirm_m]
        )

    def missed(self, through: I4, confirming: I4) -> NDArray[np.bool_]:
        """Whether new scans with these counts (n,) say that nothing is there."""
        return np.asarray((through >= self.min_scans) & (confirming <= self.max_confirming * through))

    def stood(self, through: I4, confirming: I4) -> NDArray[np.bool_]:
        """Whether old scans with these counts (n,) say that something stood there."""
        return np.asarray((confirming >= self.min_scans) & (through <= self.max_through_before * confirming))
