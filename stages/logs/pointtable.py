"""Points in files as structured arrays, from bytes or from text."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput

MOST_BYTES = 2 << 30
"""A header that claims more than this is damaged, not big."""


def binary_table(body: bytes, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    """Points (points,) of a binary body.

    Raises
    ------
    InvalidInput : the body is too short, or the number of points cannot be true.
    """
    needed = needed_bytes(dtype, points)
    if len(body) < needed:
        raise InvalidInput(f"is cut short: {len(body)} of {needed} bytes of points")
    return np.frombuffer(body, dtype, points)


def text_table(body: bytes, dtype: np.dtype[Any], points: int) -> NDArray[Any]:
    """Points (points,) of a text body: numbers separated by blanks, one point a line.

    Raises
    ------
    InvalidInput : lines or numbers are missing, or some are no numbers.
    """
    needed_bytes(dtype, points)
    widths = [int(np.prod(dtype[name].shape, dtype=int)) for name in dtype.names or ()]
    table = np.zeros(points, dtype)
    if points == 0:
        return table
    try:
        # Doubles hold every field exactly but 64-bit integers, which no writer puts into text.
        values = np.loadtxt(io.BytesIO(body), np.float64, max_rows=points, ndmin=2, comments=None)
    except ValueError as error:
        raise InvalidInput(f"holds a line that is no point: {error}") from error
    if len(values) < points or values.shape[1] < sum(widths):
        raise InvalidInput(f"is cut short: {len(values)} of {points} points with {sum(widths)} numbers")
    start = 0
    with np.errstate(invalid="ignore"):
        for name, width in zip(dtype.names or (), widths):
            table[name] = values[:, start : start + width].reshape(points, *dtype[name].shape)
            start += width
    return table


def needed_bytes(dtype: np.dtype[Any], points: int) -> int:
    """Bytes of so many points; InvalidInput when nobody has that many."""
    needed = points * dtype.itemsize
    if needed > MOST_BYTES:
        raise InvalidInput(f"claims {points} points, more than can be true")
    return needed
