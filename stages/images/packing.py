"""Images of a log as files: what is encoded stays as it is, raw pixels become PNG without loss."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.pictures import MAX_PIXELS, is_whole, kind_of, size_of
from scanloom.stages.logs.cameras import bytes_of
from scanloom.stages.logs.records import AnyImage, CompressedImage, ImageFile, RawImage

Bytes = NDArray[np.uint8]
Pixels = NDArray[Any]

# encoding of sensor_msgs/Image: (type of a sample, samples per pixel, OpenCV's conversion to blue green red)
_LAYOUTS: dict[str, tuple[str, int, str]] = {
    "mono8": ("u1", 1, ""), "8uc1": ("u1", 1, ""), "mono16": ("u2", 1, ""), "16uc1": ("u2", 1, ""),
    "bgr8": ("u1", 3, ""), "8uc3": ("u1", 3, ""), "rgb8": ("u1", 3, "COLOR_RGB2BGR"),
    "bgra8": ("u1", 4, "COLOR_BGRA2BGR"), "8uc4": ("u1", 4, "COLOR_BGRA2BGR"), "rgba8": ("u1", 4, "COLOR_RGBA2BGR"),
    "bgr16": ("u2", 3, ""), "16uc3": ("u2", 3, ""), "rgb16": ("u2", 3, "COLOR_RGB2BGR"),
    "yuv422": ("u1", 2, "COLOR_YUV2BGR_UYVY"), "uyvy": ("u1", 2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": ("u1", 2, "COLOR_YUV2BGR_YUY2"), "yuyv": ("u1", 2, "COLOR_YUV2BGR_YUY2"),
    **{
        f"bayer_{pattern}{bits}": (f"u{bits // 8}", 1, f"COLOR_Bayer{pattern.upper()}2BGR")
        for pattern in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)
    },
}  # fmt: skip


def packed(body: AnyImage) -> tuple[Bytes, str]:
    """The bytes of an image as in a file, and `jpeg` or `png`. Mosaics of colour filters are interpolated.

    Raises
    ------
    ValueError : the image is damaged or of a kind that is no picture; a part of a sentence that says how.
    """
    if isinstance(body, RawImage):
        return _png(_converted(body.encoding, _pixels(body)))
    data = bytes_of(body)
    if isinstance(body, CompressedImage) and _needs_conversion(body.format):
        return _png(_converted(body.format.split(";")[0].strip(), _decoded(data)))
    kind = kind_of(data)
    if not kind:
        where = "the file" if isinstance(body, ImageFile) else f"its format is {body.format!r}, and"
        raise ValueError(f"{where} holds neither JPEG nor PNG")
    if size_of(data) is None or not is_whole(data):
        raise ValueError(f"the {kind.upper()} is not whole")
    return np.array(data), kind


def _needs_conversion(form: str) -> bool:
    """A mosaic in a PNG; `image_transport` says `ORIGINAL; CODEC compressed [WHAT]`."""
    original, _, rest = form.lower().partition(";")
    return original.strip().startswith("bayer_") and "bgr" not in rest and "rgb" not in rest


def _pixels(body: RawImage) -> Pixels:
    """Samples (h, w, c) as the message has them, its padding left out."""
    layout = _LAYOUTS.get(body.encoding.lower())
    if layout is None:
        raise ValueError(f"encoding {body.encoding!r} is no picture that can be read")
    code, count, _ = layout
    row_bytes = body.width * count * int(code[1])
    if not 0 < body.width * body.height <= MAX_PIXELS or body.step < row_bytes:
        raise ValueError(f"{body.width} x {body.height} px in rows of {body.step} bytes make no sense")
    if len(body.data) < (body.height - 1) * body.step + row_bytes:
        raise ValueError(f"the image ends after {len(body.data)} of {body.height * body.step} bytes")
    rows = np.lib.stride_tricks.as_strided(body.data, (body.height, row_bytes), (body.step, 1))
    dtype = np.dtype(code).newbyteorder(">" if body.is_bigendian else "<")
    pixels = np.ascontiguousarray(rows).view(dtype).astype(code)
    return pixels.reshape(body.height, body.width, count) if count > 1 else pixels


def _converted(encoding: str, pixels: Pixels) -> Pixels:
    import cv2

    _, _, conversion = _LAYOUTS.get(encoding.lower(), ("", 0, ""))
    if not conversion:
        return pixels
    if pixels.shape[1] < 2 or pixels.shape[0] < 2:
        raise ValueError("the image is too small for its encoding")
    try:
        return np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)))
    except cv2.error as error:
        raise ValueError(f"its pixels do not fit encoding {encoding!r}") from error


def _decoded(data: Bytes) -> Pixels:
    import cv2

    pixels = (
        cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if size_of(data) is not None and is_whole(data) else None
    )
    if pixels is None:
        raise ValueError("the image is not whole")
    return np.asarray(pixels)


def _png(pixels: Pixels) -> tuple[Bytes, str]:
    """Quickly rather than small: the images are read once or twice."""
    import cv2

    done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("it cannot be packed as PNG")
    return np.asarray(data, np.uint8).reshape(-1), "png"
