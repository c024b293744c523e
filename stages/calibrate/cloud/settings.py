"""How a board is looked for in a cloud."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class CloudSettings(BaseModel):
    """What counts as a board, and what is known of the sensor."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = Field(default=0, ge=0, le=2**31, description="seed of the planes that are tried")
    max_range_m: float = Field(
        default=12.0, ge=1.0, le=100.0, description="boards farther away are not looked for, m"
    )
    min_range_m: float = Field(
        default=0.4, ge=0.05, le=10.0, description="nearer points belong to the rig, m"
    )
    plane_m: float = Field(
        default=0.03, ge=0.002, le=0.2, description="distance of a board's points from its plane, at most, m"
    )
    extent_share: float = Field(
        default=0.1,
        ge=0.01,
        le=0.5,
        description="how far the measured size may be off, as a share of the board's",
    )
    min_rings: int = Field(
        default=4, ge=3, le=128, description="beams that must cross a board, at least, number"
    )
    min_points: int = Field(default=40, ge=12, le=100_000, description="points on a board, at least, number")
    reflectance: Literal["auto", "ignore", "require"] = Field(
        default="auto",
        description="auto: squares are used where they can be seen; ignore: by shape alone; require: boards without visible squares are refused",
    )
    static_m: float = Field(
        default=0.08, ge=0.01, le=1.0, description="points nearer than this to the background belong to it, m"
    )
    footprint_m: float = Field(
        default=0.01, ge=0.0, le=0.2, description="width of the beam where it leaves the sensor, m"
    )
    divergence_rad: float = Field(
        default=0.003, ge=0.0, le=0.05, description="by how much the beam widens, full angle, rad"
    )
    range_sigma_m: float = Field(
        default=0.02,
        ge=0.001,
        le=0.2,
        description="expected noise of a range; the board's own scatter decides, m",
    )
    beam_sigma_m: float = Field(
        default=0.006,
        ge=0.0,
        le=0.1,
        description="expected difference between the ranges of the beams, one sigma, m",
    )
