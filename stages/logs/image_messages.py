"""Images and camera models from their messages; the pixels are not copied and not looked at."""

from __future__ import annotations

import numpy as np

from scanloom.stages.logs.cursor import Cursor
from scanloom.stages.logs.records import Body, CameraInfo, CompressedImage, RawImage

_MOST_COEFFICIENTS = 14


def raw_image(c: Cursor, receive_ns: int) -> Body:
    """sensor_msgs/Image. Raises ValueError when the bytes do not fit."""
    stamp_ns, frame = c.header()
    height, width = int(c.number("I")), int(c.number("I"))
    encoding = c.text()
    bigendian = bool(c.number("B"))
    step = int(c.number("I"))
    data = np.frombuffer(c.take(int(c.number("I"))), np.uint8)
    return RawImage(stamp_ns, receive_ns, frame, height, width, encoding, bigendian, step, data)


def compressed_image(c: Cursor, receive_ns: int) -> Body:
    """sensor_msgs/CompressedImage. Raises ValueError when the bytes do not fit."""
    stamp_ns, frame = c.header()
    form = c.text()
    return CompressedImage(
        stamp_ns, receive_ns, frame, form, np.frombuffer(c.take(int(c.number("I"))), np.uint8)
    )


def camera_info(c: Cursor, receive_ns: int) -> Body:
    """sensor_msgs/CameraInfo. Raises ValueError when the bytes do not fit."""
    stamp_ns, frame = c.header()
    height, width = int(c.number("I")), int(c.number("I"))
    lens = c.text()
    distortion = c.doubles(c.length(_MOST_COEFFICIENTS))
    K, R, P = c.doubles(9), c.doubles(9), c.doubles(12)
    binning = (int(c.number("I")), int(c.number("I")))
    x, y = int(c.number("I")), int(c.number("I"))
    c.read("I", 2)
    return CameraInfo(stamp_ns, receive_ns, frame, height, width, lens, distortion, K, R, P, binning, (x, y))
