"""Denoise: a class for every point. Nothing is deleted here; what is not scenery is named.

Own vehicle, out of range, standing alone, ground; the rest is static until a later stage knows better.
Source: methods 1.5 (Ren et al. 2021, steps c and d) and 2.3.1 for the ground.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.stages.denoise.bounds import bounded
from scanloom.stages.denoise.settings import Settings
from scanloom.stages.geometry.ground import ground_mask
from scanloom.stages.geometry.isolation import isolated
from scanloom.stages.geometry.se3 import F8

VERSION = 1

U1 = NDArray[np.uint8]

USUAL_BEAMS = 32
FINEST_STEP_RAD, COARSEST_STEP_RAD = 0.001, 0.02


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
    classes = bounded(
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
