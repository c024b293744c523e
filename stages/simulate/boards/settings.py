"""What can be asked of a simulated calibration session."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Bad = Literal["moved", "glare", "wrong board", "no board"]
"""moved: the board moved between cloud and images; glare: a lamp is mirrored in it; wrong board: another one was held up;
no board: nobody was there."""


class BoardSettings(BaseModel):
    """A rig of one LiDAR and one to three cameras, and a chessboard shown in several places."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cameras: int = Field(3, ge=1, le=3, description="cameras: front, left, right")
    placements: int = Field(12, ge=1, le=100, description="places where the board is shown")
    bad: tuple[Bad, ...] = Field((), description="what goes wrong, each at a placement of its own")
    swapped: bool = Field(False, description="images of the first two cameras lie in each other's folders")
    inner_corners: tuple[int, int] = Field(
        (7, 5), description="inner corners along the board's two dimensions"
    )
    square_m: float = Field(0.095, ge=0.01, le=0.5, description="side of a square, m")
    board_m: tuple[float, float] = Field((0.85, 0.61), description="size of the plate, m")
    offset_m: tuple[float, float] = Field(
        (0.002, 0.0), description="centre of the plate minus centre of the pattern, m"
    )
    hung: Literal["diamond", "upright", "mixed"] = Field("diamond", description="how the board is held")
    nearest_m: float = Field(2.0, ge=1.0, le=10.0, description="least distance of the board, m")
    farthest_m: float = Field(4.0, ge=1.0, le=12.0, description="largest distance of the board, m")
    tilt_deg: float = Field(35.0, ge=0.0, le=70.0, description="largest tilt of the board, each axis, deg")

    beams: Literal[16, 32, 64] = Field(32, description="beams of the LiDAR")
    columns: int = Field(1800, ge=180, le=4096, description="firings in a turn")
    range_noise_m: float = Field(0.02, ge=0.0, le=0.2, description="standard deviation of a range, m")
    range_offset_m: float = Field(
        0.003, ge=0.0, le=0.1, description="standard deviation of what all ranges are off by, m"
    )
    beam_range_error_m: float = Field(
        0.006, ge=0.0, le=0.1, description="standard deviation of what each beam is off by, m"
    )
    beam_angle_error_deg: float = Field(
        0.02, ge=0.0, le=1.0, description="standard deviation of a beam's direction, each axis, deg"
    )
    dark_m: float = Field(0.008, ge=0.0, le=0.1, description="black reads so much farther than white, m")
    divergence_rad: float = Field(0.003, ge=0.0, le=0.02, description="full width of the beam, rad")

    width_px: int = Field(1280, ge=320, le=4096, description="width of an image, px")
    height_px: int = Field(960, ge=240, le=4096, description="height of an image, px")
    blur_px: float = Field(0.6, ge=0.0, le=5.0, description="standard deviation of a point in the image, px")
    corner_noise_px: float = Field(
        0.15, ge=0.0, le=5.0, description="noise of corners where no image is rendered, px"
    )
    focal_error: float = Field(
        2e-4, ge=0.0, le=0.05, description="standard deviation of the given focal length, as a share of it"
    )
    mount_deg: float = Field(
        3.0, ge=0.0, le=20.0, description="how far cameras are from where they belong, deg"
    )
    mount_m: float = Field(0.05, ge=0.0, le=0.5, description="the same along each axis, m")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if len(self.bad) > self.placements:
            raise ValueError("bad: more goes wrong than there are placements")
        if self.farthest_m < self.nearest_m:
            raise ValueError("farthest_m: nearer than nearest_m")
        if self.swapped and self.cameras < 2:
            raise ValueError("swapped: needs two cameras")
        for corners, plate, offset in zip(self.inner_corners, self.board_m, self.offset_m):
            if corners < 2 or (corners - 1) * self.square_m / 2 + abs(offset) > plate / 2:
                raise ValueError("inner_corners, board_m: the pattern is larger than the plate")
        return self
