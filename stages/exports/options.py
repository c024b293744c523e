"""What the user may ask of an export."""

from __future__ import annotations

from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

ELLIPSOIDAL: Final = "ellipsoidal"
ORTHOMETRIC: Final = "orthometric"


class Options(BaseModel):
    """Where the coordinates of an export stand, and which points are in it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    epsg: int | None = Field(
        None, ge=1024, le=998_999, description="projected system; default the map's own UTM zone, EPSG code"
    )
    heights: Literal["ellipsoidal", "orthometric"] = Field(
        ELLIPSOIDAL, description="above the WGS84 ellipsoid, or above the geoid of `vertical_epsg`"
    )
    vertical_epsg: int = Field(
        5773, ge=1024, le=998_999, description="system of orthometric heights (5773: EGM96), EPSG code"
    )
    removed: bool = Field(
        False, description="whether points that are left out of the map come too, with their classes"
    )
    per_tile: bool = Field(False, description="whether LAZ has one file per tile besides the whole map")
    cell_m: float = Field(0.25, ge=0.01, le=100.0, description="edge of a cell of rasters, m")
    fill_cells: int = Field(
        4, ge=0, le=40, description="cells up to which ground heights are interpolated into holes"
    )
