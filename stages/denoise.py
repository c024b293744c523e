"""Denoise: a class for every point. Nothing is deleted here; what is not scenery is named.

Own vehicle, out of range, standing alone, ground; the rest is static until a later stage knows better.
Source: methods 1.5 (Ren et al. 2021, steps c and d) and 2.3.1 for the ground.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.stages.geometry.ground import ground_mask
from scanloom.stages.geometry.isolation import isolated
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8

VERSION = 1

F4 = NDArray[np.float32]
U1 = NDArray[np.uint8]
Corner = tuple[float, float, float]

USUAL_BEAMS = 32
OUT_OF_RANGE, EGO, STATIC = int(PointClass.OUT_OF_RANGE), int(PointClass.EGO), int(PointClass.STATIC)
FINEST_STEP_RAD, COARSEST_STEP_RAD = 0.001, 0.02


class Settings(BaseModel):
    """Bounds of what counts as scenery."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_range_m: float = Field(2.0, ge=0.0, le=20.0, description="nearer points are out of range, m")
    max_range_m: float = Field(100.0, ge=1.0, le=1000.0, description="farther points are out of range, m")
    ego_low_m: Corner = Field(
        (-1.2, -1.0, 0.2),
        description="lower corner of the own vehicle in the base frame, m; default: a car on the ground",
    )
    ego_high_m: Corner = Field(
        (3.8, 1.0, 1.9),
        description="upper corner of the own vehicle in the base frame, m; it never reaches above the LiDAR",
    )
    outlier_neighbours: int = Field(
        2, ge=0, le=50, description="a point with fewer neighbours is an outlier, number; 0 keeps all"
    )
    outlier_radius_m: float = Field(
        0.2, ge=0.01, le=5.0, description="radius in which neighbours count, at least, m"
    )
    outlier_steps: float = Field(
        4.0,
        ge=0.5,
        le=20.0,
        description="radius in which neighbours count, in azimuth steps of the sensor, number",
    )
    ground_height_m: float = Field(
        0.15, ge=0.02, le=1.0, description="points less than this above the ground's height are ground, m"
    )


def denoise(settings: Settings, deskewed: Deskewed, session: Session) -> Labels:
    """A `PointClass` for every point of every scan of a chunk, scan by scan, in the order of the points."""
    T_base_lidar = np.array(session.T_base("lidar"), float)
    return Labels(_labelled(settings, deskewed, T_base_lidar, session.beams))


def _labelled(settings: Settings, deskewed: Deskewed, T_base_lidar: F8, beams: int) -> Iterator[ScanLabels]:
    for scan in deskewed:
        classes = classify(settings, scan, T_base_lidar, beams)
        yield ScanLabels(class_=classes, reference_ns=scan.reference_ns, scan_index=scan.scan_index)


def classify(settings: Settings, scan: DeskewedScan, T_base_lidar: F8, beams: int) -> U1:
    """Classes (n,) of the points of one scan; `beams` of the sensor, 0 when unknown."""
    x, y, z = scan.x_m, scan.y_m, scan.z_m
    classes = _bounded(
        x, y, z, T_base_lidar, np.array(settings.ego_low_m), np.array(settings.ego_high_m),
        settings.min_range_m, settings.max_range_m,
    )  # fmt: skip
    if settings.outlier_neighbours > 0:
        lonely = isolated(
            x, y, z, classes == PointClass.STATIC,
            radius_m=settings.outlier_radius_m,
            radius_rad=settings.outlier_steps * azimuth_step_rad(len(scan), beams),
            least_neighbours=settings.outlier_neighbours,
        )  # fmt: skip
        classes[lonely] = PointClass.OUTLIER
    ground = ground_mask(
        x, y, z, classes == PointClass.STATIC, T_base_lidar[:3, :3], settings.ground_height_m
    )
    classes[ground] = PointClass.GROUND
    return classes


def azimuth_step_rad(points: int, beams: int) -> float:
    """Angle between neighbouring points of a beam, from their number; too wide, not too narrow, if many are missing."""
    step = 2 * np.pi * (beams or USUAL_BEAMS) / max(points, 1)
    return float(np.clip(step, FINEST_STEP_RAD, COARSEST_STEP_RAD))


@kernel
def _bounded(x: F4, y: F4, z: F4, T: F8, low: F8, high: F8, nearest: float, farthest: float) -> U1:
    """OUT_OF_RANGE, EGO, or STATIC for the rest."""
    out = np.empty(len(x), np.uint8)
    top = min(high[2], T[2, 3])
    reach2 = _reach2(T, low, high)
    for i in range(len(x)):
        px, py, pz = float(x[i]), float(y[i]), float(z[i])
        square = px * px + py * py + pz * pz
        if not (0.0 < square <= farthest * farthest):  # also catches NaN
            out[i] = OUT_OF_RANGE
            continue
        if square > reach2 and square >= nearest * nearest:
            out[i] = STATIC
            continue
        u = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        v = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        w = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if low[0] < u < high[0] and low[1] < v < high[1] and low[2] < w < top:
            out[i] = EGO
        elif square < nearest * nearest:
            out[i] = OUT_OF_RANGE
        else:
            out[i] = STATIC
    return out


@kernel
def _reach2(T: F8, low: F8, high: F8) -> float:
    """Square of a distance from the LiDAR, m2, that the own vehicle does not reach."""
    square = 0.0
    for k in range(3):
        square += max(abs(low[k] - T[k, 3]), abs(high[k] - T[k, 3])) ** 2
    return 1.001 * square
