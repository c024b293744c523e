"""Settings of colour."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class Settings(BaseModel):
    """Which views colour a point."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_m: float = Field(
        40.0, ge=1.0, le=200.0, description="points farther from the camera get no colour from it, m"
    )
    nearest_m: float = Field(2.0, ge=0.0, le=20.0, description="nor do points nearer than this, m")
    apart_m: float = Field(
        0.5, ge=0.0, le=20.0,
        description="an image taken so near to the camera's last one, and turned by less than 5 degrees, adds nothing, m",
    )  # fmt: skip
    tolerance_m: float = Field(
        0.1, ge=0.01, le=5.0, description="what stands out of a point's surface by no more hides nothing, m"
    )
    margin_px: float = Field(
        2.0, ge=0.0, le=50.0, description="pixels beside the edge of something nearer that colour nothing, px"
    )
    least_cosine: float = Field(
        0.05,
        ge=0.0,
        le=0.9,
        description="a surface that is looked along, by a smaller cosine between ray and normal, or from behind, is not seen",
    )
    bare_m: float = Field(
        20.0, ge=0.0, le=200.0,
        description="points without a surface (bushes, lone points) get no colour from farther than this, m",
    )  # fmt: skip
    alone: float = Field(
        2.0,
        ge=1.0,
        le=10.0,
        description="a point that one image alone shows is held to be seen only with so many times `least_cosine`, and so much less than `tolerance_m` before it; 1 asks no more of it",
    )
    darkest: int = Field(6, ge=0, le=255, description="darker pixels of 8 bits say nothing of colour")
    brightest: int = Field(250, ge=1, le=255, description="brighter pixels are taken to be saturated")
    agree: float = Field(
        0.25,
        ge=0.01,
        le=10.0,
        description="views whose light is off what most of a point's views say by this factor, as a logarithm, count less",
    )
    own_share: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description="a part of a camera's picture of whose views so many disagree shows the vehicle itself; 1 looks for none",
    )
    moving_margin_m: float = Field(
        0.4, ge=0.0, le=5.0, description="boxes of moving objects grow by this to all sides, m"
    )
    tiles_held: int = Field(16, ge=1, le=1000, description="tiles that stay in memory, number")
