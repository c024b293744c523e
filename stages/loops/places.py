"""Places: descriptors of each keyframe, by which a place is known again from any heading and from the next lane.

STV-SC (Tian et al. 2022; methods 2.3, 2.4): the scan context of all that stands there, and that of its segments alone,
which leaves what is no structure aside. Both also as seen from the lanes to the left and to the right (the idea of Scan
Context++, Kim et al. 2021): on the way back a vehicle drives some metres beside its own track.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.loops import Places
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.lookahead import ahead
from scanloom.stages.geometry.range_image import ImageSettings, range_image
from scanloom.stages.loops.reading import keyframe_scans
from scanloom.stages.loops.scan_context import F4, RINGS, SECTORS, scan_contexts
from scanloom.stages.loops.segmentation import SegmentationSettings, segments

VERSION = 2

LEFT_OUT = (int(PointClass.DYNAMIC), int(PointClass.AIRBORNE), int(PointClass.EGO), int(PointClass.OUTLIER), int(PointClass.OUT_OF_RANGE))  # fmt: skip
FIRST_LEFT_OUT = min(LEFT_OUT)
SHAPE = (RINGS, SECTORS)


class Settings(BaseModel):
    """How a place is described. Rings and sectors, 20 and 60, are part of the product."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_radius_m: float = Field(default=80.0, gt=5, le=500, description="radius of the outermost ring, m")
    height_offset_m: float = Field(
        default=2.5,
        ge=0,
        le=20,
        description="added to heights so that the ground is not below zero: the LiDAR's height or more, m",
    )
    lane_m: float = Field(
        default=3.5, ge=0, le=20, description="how far beside the LiDAR the next lanes are, m"
    )
    image: ImageSettings = Field(default_factory=ImageSettings, description="range image for the segments")
    segmentation: SegmentationSettings = Field(
        default_factory=SegmentationSettings, description="which points are one segment, and which count"
    )


@dataclass(frozen=True)
class Description:
    """What one keyframe looks like: heights (20, 60), and (2, 20, 60) from the lanes to the left and to the right."""

    descriptor: F4
    beside: F4
    segment_descriptor: F4
    segment_beside: F4


def places(settings: Settings, deskewed: Deskewed, labels: Labels, odometry: Odometry) -> Places:
    """Descriptors of the keyframes of one chunk. Reads one scan at a time, and only keyframes.

    Raises
    ------
    StageError : labels do not fit the scans.
    """
    stamp = dict(zip(odometry.scan_index.tolist(), odometry.stamp_ns.tolist(), strict=True))
    wanted = set(odometry.scan_index[odometry.keyframe].tolist())
    indices, found = [], []
    for scan, label in ahead(keyframe_scans(deskewed, labels, wanted)):
        indices.append(scan.scan_index)
        found.append(describe(settings, scan, label))
    return Places(
        scan_index=np.array(indices, np.int64),
        stamp_ns=np.array([stamp[i] for i in indices], np.int64),
        descriptor=_stacked([f.descriptor for f in found], SHAPE),
        beside=_stacked([f.beside for f in found], (2, *SHAPE)),
        segment_descriptor=_stacked([f.segment_descriptor for f in found], SHAPE),
        segment_beside=_stacked([f.segment_beside for f in found], (2, *SHAPE)),
        max_radius_m=settings.max_radius_m,
        lane_m=settings.lane_m,
    )


def describe(settings: Settings, scan: DeskewedScan, label: ScanLabels) -> Description:
    """All descriptors of one scan; those of its segments from the points that are left without ground and leaves."""
    x, y, z = scan.x_m, *_upright(scan, label)
    belongs = label.class_ < FIRST_LEFT_OUT
    structure = belongs & (label.class_ != PointClass.GROUND)
    image = range_image(settings.image, x, y, z, belongs, structure)
    kept = segments(settings.segmentation, image, np.column_stack((x, y, z)), scan.intensity)
    cells = image.point[kept > 0]
    every = _around(settings, x, y, z, belongs)
    solid = _around(settings, x[cells], y[cells], z[cells], np.ones(len(cells), np.bool_))
    return Description(every[0], every[1:], solid[0], solid[1:])


def _around(settings: Settings, x: F4, y: F4, z: F4, drawn: NDArray[np.bool_]) -> F4:
    """Scan contexts (3, 20, 60) from the LiDAR, from its left and from its right."""
    lanes = (0.0, settings.lane_m, -settings.lane_m)
    return scan_contexts(x, y, z, drawn, settings.max_radius_m, settings.height_offset_m, lanes)


def _upright(scan: DeskewedScan, label: ScanLabels) -> tuple[F4, F4]:
    """y and z; half a turn about x where the ground is above the sensor, which then hangs upside down."""
    ground = scan.z_m[label.class_ == PointClass.GROUND]
    if len(ground) and np.median(ground) > 0:
        return -scan.y_m, -scan.z_m
    return scan.y_m, scan.z_m


def _stacked(found: list[F4], shape: tuple[int, ...]) -> F4:
    return np.array(found, np.float32).reshape(-1, *shape)
