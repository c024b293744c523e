"""Settings of the tracker."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Settings(BaseModel):
    """What is tracked, and when it counts as moving."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_range_m: float = Field(60.0, ge=5.0, le=100.0, description="things farther away are not tracked, m")
    lowest_m: float = Field(
        0.3, ge=0.05, le=2.0, description="points lower above the ground are not used to track, m"
    )
    highest_m: float = Field(
        2.2, ge=0.5, le=10.0, description="points higher above the ground are not used to track, m"
    )
    link_m: float = Field(
        0.25, ge=0.1, le=2.0, description="edge of the cells whose neighbours belong to one thing, m"
    )
    longest_m: float = Field(13.0, ge=2.0, le=30.0, description="longer things are structures, m")
    widest_m: float = Field(3.2, ge=1.0, le=10.0, description="wider things are structures, m")
    min_points: int = Field(5, ge=2, le=100, description="fewer points do not start a track, number")
    min_displacement_m: float = Field(
        1.0, ge=0.2, le=10.0, description="what moved less than this does not count as moving, m"
    )
    min_sigmas: float = Field(
        3.0, ge=0.0, le=10.0, description="nor what moved less than so many standard deviations, number"
    )
    min_scans: int = Field(3, ge=2, le=50, description="nor what was seen in fewer scans, number")
    min_score: float = Field(
        0.7,
        ge=0.0,
        le=1.0,
        description="share of the places it left, or came to, that were seen to be empty, number",
    )
    parked_s: float = Field(
        5.0, ge=0.0, le=100.0, description="what stands so long to the end of its track has parked, s"
    )
    lost_s: float = Field(0.6, ge=0.0, le=10.0, description="a track that is not seen for longer ends, s")
