"""Clock and antenna of each session's GNSS receiver put right before its fixes are judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np

from scanloom.stages.fusion import clock, lever_arm
from scanloom.stages.fusion.calibration import Calibration, Motion, calibrate
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.gnss import middle, positions
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.fusion.gravity import Gravity, level
from scanloom.stages.fusion.receiver import screened
from scanloom.stages.geometry.se3 import F8, pose

CLOCK_SIGMA_S, ANTENNA_SIGMA_M, SCALE_SIGMA = 0.3, 2.0, 0.02
PINNED_S, PINNED_M = 1e-4, 1e-3
CLEAR_SCALE = 0.005


def tuned(
    settings: GnssSettings, drives: Sequence[Drive], ups: Sequence[Gravity]
) -> tuple[list[Drive], list[str]]:
    """The drives with the clock and antenna that their motion tells, where it tells them clearly, and what was found."""
    out: list[Drive] = []
    remarks: list[str] = []
    for name, segments in groupby(zip(drives, ups, strict=True), key=lambda pair: pair[0].name):
        parts = list(segments)
        own, told = _session_tuned(settings, [d for d, _ in parts], [u for _, u in parts])
        out += own
        remarks += [f"{name}: {text}" for text in told]
    return out, remarks


def _session_tuned(
    settings: GnssSettings, drives: list[Drive], ups: list[Gravity]
) -> tuple[list[Drive], list[str]]:
    motions = [m for d, up in zip(drives, ups, strict=True) if (m := _motion(settings, d, up)) is not None]
    if not motions:
        return drives, []
    free = not lever_arm.told(drives[0].session)
    found, offset, arm = _found(settings, motions, drives[0], free)
    if found is None:
        return drives, []
    return [_corrected(d, found, offset, arm) for d in drives], _remarks(found, offset, arm, free)


def _found(
    settings: GnssSettings, motions: list[Motion], drive: Drive, free: bool
) -> tuple[Calibration | None, bool, bool]:
    """Clock and antenna together; when only one of them is clear it is found once more with the other as it was."""
    base = drive.T_base_lidar[:3, :3].T[:, :2]
    lag = clock.lag_by_distances(motions, drive.antenna_m, settings.max_clock_offset_s)
    start = np.array([lag, 0.0, 0.0, 1.0])
    wide = np.array([CLOCK_SIGMA_S, ANTENNA_SIGMA_M, ANTENNA_SIGMA_M, SCALE_SIGMA])
    if not free:
        wide[1:3] = PINNED_M
    if settings.max_clock_offset_s == 0.0:
        wide[0] = PINNED_S
    found = calibrate(motions, drive.antenna_m, base, start, wide)
    if found is None:
        return None, False, False
    offset, arm = clock.clear(found), free and lever_arm.clear(found)
    if offset != arm and free:
        start[0], wide[0] = (found.value[0], wide[0]) if offset else (0.0, PINNED_S)
        wide[1:3] = ANTENNA_SIGMA_M if arm else PINNED_M
        again = calibrate(motions, drive.antenna_m, base, start, wide)
        found = again or found
    return found, offset, arm


def _motion(settings: GnssSettings, drive: Drive, up: Gravity) -> Motion | None:
    """Levelled odometry and the fixes its receiver stands for; None without any."""
    good = np.flatnonzero(screened(settings, drive) == "")
    if len(good) < 2 or len(drive.odometry) < 2:
        return None
    gnss = drive.gnss.take(good)
    T_level_odom = pose(level(drive, up), np.zeros(3))
    T: F8 = T_level_odom @ drive.odometry.T_odom_lidar
    return Motion(drive.odometry.stamp_ns, T, gnss.stamp_ns, positions(gnss, middle(gnss))[:, :2])


def _corrected(drive: Drive, found: Calibration, offset: bool, arm: bool) -> Drive:
    if offset:
        late_ns = round(float(found.value[0]) * 1e9)
        drive = replace(drive, gnss=replace(drive.gnss, stamp_ns=drive.gnss.stamp_ns + late_ns))
    if arm:
        shift = np.array([found.value[1], found.value[2], 0.0])
        drive = replace(drive, session=lever_arm.with_antenna(drive.session, shift))
    return drive


def _remarks(found: Calibration, offset: bool, arm: bool, free: bool) -> list[str]:
    told = []
    if offset:
        told.append(clock.said(found))
    if arm:
        told.append(lever_arm.said(found, found.value[1:3]))
    elif free and found.sigma[1:3].max() > lever_arm.LARGEST_SIGMA_M:
        told.append(lever_arm.UNKNOWN)
    scale, sigma = float(found.value[3]) - 1.0, float(found.sigma[3])
    if abs(scale) > max(4.0 * sigma, CLEAR_SCALE):
        longer = "longer" if scale > 0 else "shorter"
        told.append(f"distances by GNSS are {100 * abs(scale):.1f} % {longer} than by odometry")
    return told
