"""Denoise: a class for every point. Nothing is deleted here; what is not scenery is named.

Own vehicle, out of range, ground, standing alone without being met again; then, by the scans shortly before and after, what
is in the air and what moves; the rest is static until a later stage knows better.
Source: methods 1.5 (Ren et al. 2021, steps c and d) and 2.3.1 for the ground.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise.airborne import airborne
from scanloom.stages.denoise.asking import met_again
from scanloom.stages.denoise.bounds import bounded
from scanloom.stages.denoise.moving import Movers
from scanloom.stages.denoise.settings import Settings
from scanloom.stages.denoise.window import Moment, View, moments
from scanloom.stages.geometry.ground import ground_mask
from scanloom.stages.geometry.isolation import isolated
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.range_image import ImageSettings, range_image
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.spacing import azimuth_step_rad
from scanloom.stages.geometry.traction import without_slips

VERSION = 4

U1 = NDArray[np.uint8]

REACH = 8
NEAR_REACH, FAR_REACH = 1.0, 1.5
"""Half of the edge of the box of an isolated point, over the radius that is set: neighbours in its corners count, too."""
IMAGE = ImageSettings(rows=128, columns=2048)


def denoise(
    settings: Settings,
    deskewed: Deskewed,
    session: Session,
    imu: Imu,
    wheel: Wheel,
    check: SensorCheck | None = None,
) -> Labels:
    """A `PointClass` for every point of every scan of a chunk, scan by scan, in the order of the points.

    A few scans before and after the present one are held. `check` corrects IMU and wheels first.
    """
    T_base_lidar = np.array(session.T_base("lidar"), float)
    imu, wheel = corrected(imu, wheel, check)
    track = MotionTrack.build(imu, without_slips(wheel, imu, session).wheel, session)
    views = (view(settings, scan, T_base_lidar, session.beams) for scan in deskewed)
    return Labels(_labelled(settings, moments(views, track, REACH)))


def _labelled(settings: Settings, around: Iterator[Moment]) -> Iterator[ScanLabels]:
    movers = Movers()
    for moment in around:
        scan, classes = moment.view.scan, moment.view.classes.copy()
        lonely = np.flatnonzero(classes == PointClass.OUTLIER)
        classes[lonely[met_again(moment, lonely)]] = PointClass.STATIC
        if settings.particles:
            classes[airborne(moment)] = PointClass.AIRBORNE
        if settings.moving:
            classes[movers.moving(moment, classes)] = PointClass.DYNAMIC
        yield ScanLabels(class_=classes, reference_ns=scan.reference_ns, scan_index=scan.scan_index)


def view(settings: Settings, scan: DeskewedScan, T_base_lidar: F8, beams: int) -> View:
    """What the scan alone tells: classes and range image; `beams` of the sensor, 0 when unknown."""
    x, y, z = scan.x_m, scan.y_m, scan.z_m
    classes = bounded(
        x, y, z, T_base_lidar, np.array(settings.ego_low_m), np.array(settings.ego_high_m),
        settings.min_range_m, settings.max_range_m,
    )  # fmt: skip
    seen = classes == PointClass.STATIC
    image = range_image(IMAGE, x, y, z, seen, seen)
    if settings.outlier_neighbours > 0:
        lonely = isolated(
            image, x, y, z,
            reach_m=NEAR_REACH * settings.outlier_radius_m,
            reach_rad=FAR_REACH * settings.outlier_steps * azimuth_step_rad(len(scan), beams),
            least_neighbours=settings.outlier_neighbours,
        )  # fmt: skip
        classes[lonely] = PointClass.OUTLIER
    ground = ground_mask(
        x, y, z, classes == PointClass.STATIC, T_base_lidar[:3, :3], settings.ground_height_m
    )
    classes[ground] = PointClass.GROUND
    return View(scan, classes, image)


def classify(settings: Settings, scan: DeskewedScan, T_base_lidar: F8, beams: int) -> U1:
    """Classes (n,) of the points of one scan by itself; `beams` of the sensor, 0 when unknown."""
    return view(settings, scan, T_base_lidar, beams).classes
