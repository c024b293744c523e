"""Places: one descriptor per keyframe, by which a place is known again from any heading.

Scan Context (Kim and Kim, IROS 2018; methods 2.4), written from its formulae: the highest point per ring and sector.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.loops import Places
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.lookahead import ahead
from scanloom.stages.loops.reading import keyframe_scans

VERSION = 1
RINGS, SECTORS = 20, 60


class Settings(BaseModel):
    """How a place is described."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_radius_m: float = Field(default=80.0, gt=5, le=500, description="radius of the outermost ring, m")
    height_offset_m: float = Field(
        default=2.5,
        ge=0,
        le=20,
        description="added to heights so that the ground is not below zero: the LiDAR's height or more, m",
    )


def places(
    settings: Settings, deskewed: Parts[Deskewed], labels: Parts[Labels], odometry: Odometry
) -> Places:
    """Descriptors of all keyframes of a session. Reads one scan at a time, and only keyframes.

    Raises
    ------
    StageError : labels do not fit the scans.
    """
    stamp = dict(zip(odometry.scan_index.tolist(), odometry.stamp_ns.tolist(), strict=True))
    wanted = set(odometry.scan_index[odometry.keyframe].tolist())
    indices, found = [], []
    for scan, label in ahead(keyframe_scans(deskewed, labels, wanted)):
        indices.append(scan.scan_index)
        found.append(scan_context(scan, label, settings))
    return Places(
        scan_index=np.array(indices, np.int64),
        stamp_ns=np.array([stamp[i] for i in indices], np.int64),
        descriptor=np.array(found, np.float32).reshape(-1, RINGS, SECTORS),
        max_radius_m=settings.max_radius_m,
    )


def scan_context(scan: DeskewedScan, label: ScanLabels, settings: Settings) -> NDArray[np.float32]:
    """Highest point (20, 60), m above the offset, per ring of max_radius/20 and sector of 6 degrees; empty bins are 0."""
    out = np.zeros((RINGS, SECTORS), np.float32)
    _highest(
        scan.x_m, scan.y_m, scan.z_m, label.class_, settings.max_radius_m,
        settings.height_offset_m, out,
    )  # fmt: skip
    return out


LEFT_OUT = (int(PointClass.DYNAMIC), int(PointClass.AIRBORNE), int(PointClass.EGO), int(PointClass.OUTLIER), int(PointClass.OUT_OF_RANGE))  # fmt: skip
FIRST_LEFT_OUT = min(LEFT_OUT)


@kernel
def _highest(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], label: NDArray[np.uint8],
    radius: float, offset: float, out: NDArray[np.float32],
) -> None:  # fmt: skip
    rings, sectors = out.shape
    for k in range(len(x)):
        if label[k] >= FIRST_LEFT_OUT:
            continue
        r = np.sqrt(x[k] * x[k] + y[k] * y[k])
        if not r < radius:
            continue
        turn = np.arctan2(y[k], x[k]) / (2 * np.pi)
        sector = int(np.floor((turn + 1.0) * sectors)) % sectors
        ring = min(int(r / radius * rings), rings - 1)
        height = z[k] + offset
        if height > out[ring, sector]:
            out[ring, sector] = height
