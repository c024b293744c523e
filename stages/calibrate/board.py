"""The board: a chessboard pattern of known size, printed somewhere on a plate of known size.

Its frame: origin at the centre of the pattern, x along the first dimension, y along the second, z out of the printed
face. A sensor that sees the print has a positive z.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from scanloom.schemas.errors import InvalidInput

F8 = NDArray[np.float64]
_MOST_BYTES = 1 << 16
_EXAMPLE = "inner_corners: [7, 5], square_m: 0.095, board_m: [0.850, 0.610], offset_m: [0.002, 0.0]"


class Charuco(BaseModel):
    """Markers in the white squares of the pattern."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dictionary: str = Field(description="OpenCV's name of the marker dictionary, as DICT_5X5_100")
    marker_m: float = Field(gt=0, description="side of a marker, m")
    first_id: int = Field(0, ge=0, description="number of the first marker")
    legacy: bool = Field(False, description="pattern of OpenCV before 4.6, whose first square is white")


class Board(BaseModel):
    """One chessboard on its plate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    inner_corners: tuple[int, int] = Field(description="inner corners along the first and second dimension")
    square_m: float = Field(gt=0, le=2.0, description="side of a square, m")
    board_m: tuple[float, float] = Field(description="size of the plate along the same two dimensions, m")
    offset_m: tuple[float, float] = Field(
        (0.0, 0.0), description="centre of the plate minus centre of the pattern, m"
    )
    charuco: Charuco | None = Field(None, description="markers in its squares, if any")

    @model_validator(mode="after")
    def _fits(self) -> Board:
        if not 2 <= min(self.inner_corners) <= max(self.inner_corners) <= 100:
            raise ValueError("inner_corners: a pattern has 2 to 100 of them along each side")
        for corners, plate, offset in zip(self.inner_corners, self.board_m, self.offset_m):
            if not 0 < plate <= 20 or not abs(offset) < plate:
                raise ValueError(
                    f"board_m, offset_m: no board is {plate} m long with its pattern {offset} m aside"
                )
            if (corners - 1) * self.square_m / 2 + abs(offset) > plate / 2:
                raise ValueError(
                    f"{corners} inner corners of {self.square_m} m do not fit on {plate} m of board_m"
                )
        if self.charuco is not None and self.charuco.marker_m >= self.square_m:
            raise ValueError("charuco.marker_m: a marker is smaller than its square")
        return self

    @property
    def squares(self) -> tuple[int, int]:
        """Whole squares along both dimensions."""
        return self.inner_corners[0] + 1, self.inner_corners[1] + 1

    @property
    def ambiguity(self) -> int:
        """Turns about z that a plain pattern cannot tell apart: 4 when it is square, else 2."""
        return 4 if self.inner_corners[0] == self.inner_corners[1] else 2

    def corners_m(self) -> F8:
        """Inner corners (m*n, 3) in the board frame, m; corner (i, j) is row i*n + j, x grows with i, y with j."""
        m, n = self.inner_corners
        i, j = np.divmod(np.arange(m * n), n)
        x, y = (i - (m - 1) / 2) * self.square_m, (j - (n - 1) / 2) * self.square_m
        return np.column_stack((x, y, np.zeros(m * n)))

    def outline_m(self) -> F8:
        """Vertices (4, 3) of the plate in the board frame, m, counter-clockwise from (-x, -y)."""
        signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
        xy = np.asarray(self.offset_m) + signs * np.asarray(self.board_m) / 2
        return np.column_stack((xy, np.zeros(4)))


def read_board(path: Path) -> Board:
    """The board a YAML file describes.

    Raises
    ------
    InvalidInput : no such file, no YAML, a key is missing or unknown, or a value does not fit; names the key.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise InvalidInput(
            "the board cannot be read: " + (error.strerror or str(error)),
            where=str(path),
            next_step=f"write it as in: {_EXAMPLE}",
        ) from error
    return parse_board(data, str(path))


def parse_board(data: bytes, where: str) -> Board:
    """As `read_board`, from the bytes of the file."""
    if len(data) > _MOST_BYTES:
        raise _unfit("this is too long to describe a board", where)
    try:
        entries: Any = yaml.safe_load(data)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise _unfit("the board is no YAML", where) from error
    if not isinstance(entries, dict):
        raise _unfit("the board is no list of keys and values", where)
    try:
        return Board.model_validate(entries)
    except ValidationError as error:
        raise _unfit("the board does not fit: " + _sentences(error), where) from error


def _sentences(error: ValidationError) -> str:
    parts = []
    for entry in error.errors(include_url=False):
        key = ".".join(str(part) for part in entry["loc"])
        message = entry["msg"].removeprefix("Value error, ")
        parts.append(f"{key}: {message}" if key else message)
    return "; ".join(parts)


def _unfit(what: str, where: str) -> InvalidInput:
    return InvalidInput(what, where=where, next_step=f"write it as in: {_EXAMPLE}")
