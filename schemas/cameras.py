"""Cameras: what a lens does to a ray, where a camera stands, and its images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from scanloom.schemas.product import Document, Stream, Table, attribute, column
from scanloom.schemas.session import Matrix4

Lens = Literal["pinhole", "radial-tangential", "equidistant"]
COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "pinhole": (0,),
    "radial-tangential": (4, 5, 8),
    "equidistant": (4,),
}
"""How many distortion coefficients a lens may have."""


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraModel(_Entry):
    """Intrinsics. Pixel (0, 0) is the centre of the upper left pixel; u to the right, v down."""

    lens: Lens
    width_px: int = Field(gt=0)
    height_px: int = Field(gt=0)
    fx_px: float = Field(gt=0)
    fy_px: float = Field(gt=0)
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    """radial-tangential: k1 k2 p1 p2 [k3 [k4 k5 k6]]; equidistant: k1 k2 k3 k4 (Kannala and Brandt 2006)."""

    @model_validator(mode="after")
    def _as_many_as_the_lens_has(self) -> Self:
        if len(self.distortion) not in COEFFICIENTS[self.lens]:
            wanted = " or ".join(str(n) for n in COEFFICIENTS[self.lens])
            raise ValueError(f"a {self.lens} lens has {wanted} coefficients, not {len(self.distortion)}")
        return self


class Camera(_Entry):
    """One camera of a rig. Its own axes: x right, y down, z forward."""

    name: str
    model: CameraModel
    T_lidar_camera: Matrix4 | None = None
    """Takes camera coordinates to the LiDAR's; null when nobody knows."""
    source: str = ""
    """Where the numbers come from: `camera info`, `calibration`, `kitti calibration`, `tf`, ..."""
    clock_offset_s: float = 0.0
    """How much later its stamps are than the LiDAR's clock; to be subtracted."""
    readout_s: float = Field(default=0.0, ge=0.0)
    """From the first row to the last of a rolling shutter, 0 for a global one; an image's stamp is its middle."""


Agreement = Literal["agrees", "moved", "unknown"]
"""`unknown`: images and reflectance say too little of each other, or too little was seen."""


class CameraAgreement(_Entry):
    """How well what one camera saw agrees with what the LiDAR measured there."""

    camera: str
    verdict: Agreement = "unknown"
    images: int = 0
    """Images that were compared."""
    points: int = 0
    nid: float = float("nan")
    """Normalised information distance of steps in the scans and of grey as calibrated: 0 one tells the other, 1 they are
    unrelated."""
    nid_best: float = float("nan")
    """The same where the camera fits best."""
    offset_deg: tuple[float, float, float] = (float("nan"),) * 3
    """Turn about the camera's own x, y, z that `T_lidar_camera` lacks: the camera fits best at T Exp(offset)."""
    std_deg: tuple[float, float, float] = (float("nan"),) * 3
    """Of the offset, from its spread when the images are drawn again, and what they share."""
    remark: str = ""
    """What was found, in a sentence."""

    @property
    def turned_deg(self) -> float:
        """Size of the offset."""
        return float(np.linalg.norm(self.offset_deg))


class CameraCheck(Document):
    """The cameras of a session held against the reflectance of its scans, without a target."""

    NAME: ClassVar[str] = "camera_check"

    cameras: tuple[CameraAgreement, ...] = ()


class Footage(_Entry):
    """What of a camera's images is used."""

    camera: str
    topic: str
    images: int
    """Images in the log."""
    kept: int
    """Images that go on: thinned, and whole."""
    damaged: int = 0
    first_ns: int = 0
    last_ns: int = 0


class Cameras(Document):
    """The cameras of a session; empty where it has none, or none whose model is known."""

    NAME: ClassVar[str] = "cameras"

    cameras: tuple[Camera, ...] = ()
    footage: tuple[Footage, ...] = ()
    remarks: tuple[str, ...] = ()
    """What was found odd, in sentences."""


@dataclass(frozen=True)
class Image(Table):
    """One image as the log holds it, still encoded; raw ones are packed without loss."""

    NAME: ClassVar[str] = "image"
    PACKED: ClassVar[bool] = True

    data: NDArray[np.uint8] = column("u1", "bytes of the encoded image, as in a file")
    stamp_ns: int = attribute("when the middle of it was exposed, on the LiDAR's clock, ns")
    camera: str = attribute("name of its camera")
    encoding: str = attribute("`png` or `jpeg`")
    topic: str = attribute("topic or folder it came from")


class Images(Stream[Image]):
    """Images of one stretch of a session, in order of time."""

    NAME = "images"
    SPLIT_BY = "footage"
    ITEM = Image
