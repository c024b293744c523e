"""Encoded images: how large they are, whether they are whole, and their pixels."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Image
from scanloom.schemas.errors import StageError

Pixels = NDArray[np.uint8]

MAX_PIXELS = 200_000_000
"""No camera of a vehicle has more; a file that claims so is damaged or hostile."""
_JPEG, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
_TAIL = 4096
"""Some cameras write a few bytes more after the end of the image."""


def kind_of(data: NDArray[np.uint8]) -> str:
    """`jpeg`, `png`, or empty for anything else."""
    head = data[:8].tobytes()
    if head.startswith(_JPEG):
        return "jpeg"
    return "png" if head == _PNG else ""


def is_whole(data: NDArray[np.uint8]) -> bool:
    """Whether the image ends as its format asks; a transfer that broke off leaves the start only."""
    end = _JPEG_END if kind_of(data) == "jpeg" else _PNG_END
    return end in data[-_TAIL:].tobytes()


def size_of(data: NDArray[np.uint8]) -> tuple[int, int] | None:
    """Width and height from the header, px; None when there is none or it is not credible."""
    from PIL import Image as Picture

    try:
        with Picture.open(io.BytesIO(data.tobytes()), formats=("JPEG", "PNG")) as picture:
            width, height = picture.size
    except (OSError, ValueError, SyntaxError, Picture.DecompressionBombError):
        return None
    return (width, height) if 0 < width * height <= MAX_PIXELS else None


def decode(image: Image) -> Pixels:
    """Pixels (h, w, 3), red green blue, or (h, w) of a grey image; of deeper ones the upper 8 bits in use.

    Raises
    ------
    StageError : the bytes are no image, or not a whole one.
    """
    import cv2

    pixels = None
    if size_of(image.data) is not None and is_whole(image.data):
        # orientation tags are left alone: the camera's model is of the pixels as they are stored
        pixels = cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise StageError(
            f"an image of {image.camera} cannot be decoded",
            where=f"{image.topic}, stamp {image.stamp_ns}",
            next_step="leave the camera out, or record the log again",
        )
    eight = _eight_bit(np.asarray(pixels))
    if eight.ndim == 2:
        return eight
    return np.ascontiguousarray(eight[:, :, 2::-1])


def grey(pixels: Pixels) -> Pixels:
    """Luminance (h, w) of an image of either kind (ITU-R BT.601, as OpenCV)."""
    import cv2

    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)


def _eight_bit(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> Pixels:
    """16-bit images hold 10, 12 or 14 bits as often as 16; the brightest pixel tells."""
    if pixels.dtype == np.uint8:
        return np.asarray(pixels, np.uint8)
    bits = max(int(pixels.max(initial=0)).bit_length(), 8)
    depth = next(d for d in (8, 10, 12, 14, 16) if d >= bits)
    return (pixels >> (depth - 8)).astype(np.uint8)
