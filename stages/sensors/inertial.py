"""The IMU against the motion between scans: clock, unit and axes of the gyro, unit and direction of gravity."""

from __future__ import annotations

import itertools

import numpy as np

from scanloom.schemas.rig import ImuCheck, Matrix3
from scanloom.schemas.tracks import Imu
from scanloom.stages.geometry.motion import MAX_BIAS_RAD_S, gravity_points_up
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.sensors.agreement import Agreement, Readings, Seen, agree
from scanloom.stages.sensors.clock import clear_offset, said_of_clock

GYRO_UNITS = {"rad/s": 1.0, "deg/s": float(np.pi / 180)}
UNIT_TOLERANCE = 0.1
ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665, "mg": 9.80665e-3}
GRAVITY_M_S2 = (9.0, 10.6)
LEAST_EXCITATION_RAD_S = 0.03
"""Turns slower than this drown in the errors of the registration."""
FITS, MISFITS = 0.9, 0.7
"""Correlations: a sensor that is right reaches the first, one with wrong axes stays below the second."""
AS_GOOD = 1.3
"""Axes whose residual is this many times the best one's, squared, explain the motion as well."""
CLEAR_BIAS = 5.0


def every_axes() -> F8:
    """All 48 ways to name and turn round three axes (48, 3, 3): the given one, the rotations, then the mirrored."""
    made = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            M = np.zeros((3, 3))
            M[range(3), order] = signs
            made.append(M)
    return np.array(sorted(made, key=lambda M: (-np.linalg.det(M), -np.trace(M))))


AXES = every_axes()


def accel_unit(accel: F8) -> tuple[str, float]:
    """Name and size, m/s2, of the accelerometer's unit, by the length of gravity; m/s2 when nothing fits."""
    length = np.linalg.norm(accel[np.isfinite(accel).all(axis=1)], axis=1)
    if len(length):
        typical = float(np.median(length))
        for name, size in ACCEL_UNITS.items():
            steady = np.percentile(length, 75) - np.percentile(length, 25) < 0.2 * typical
            if GRAVITY_M_S2[0] < typical * size < GRAVITY_M_S2[1] and (steady or size == 1.0):
                return name, size
    return "m/s2", 1.0


def check_imu(
    imu: Imu, seen_base: Seen, T_base_imu: F8, max_lag_s: float, stood: bool
) -> tuple[ImuCheck, list[str]]:
    """What to correct, and what to say; `seen_base` holds turn rates in the base frame, rad/s."""
    if len(imu) == 0:
        return ImuCheck(), []
    unit, accel_factor = accel_unit(imu.accel_m_s2)
    remarks = [] if accel_factor == 1.0 else [f"IMU: the accelerometer counts in {unit}; converted."]
    base = ImuCheck(verdict="unknown" if accel_factor == 1.0 else "corrected", accel_factor=accel_factor)
    R = T_base_imu[:3, :3]
    seen = Seen(seen_base.start_s, seen_base.end_s, seen_base.value @ R)
    every = agree(seen, Readings.of(imu.stamp_ns, imu.gyro_rad_s), AXES, max_lag_s)
    if not every:
        return base, [*remarks, "IMU: too few scans could be registered to judge its clock, unit and axes."]
    base = base.model_copy(
        update={"scan_pairs": every[0].pairs, "correlation_as_given": every[0].correlation}
    )
    if every[0].excitation < LEAST_EXCITATION_RAD_S:
        return base, [*remarks, "IMU: the vehicle hardly turns; nothing tells of its clock, unit and axes."]
    axes, best = _axes(every, imu, R)
    name = _unit(best)
    if best.correlation < FITS or name is None or abs(best.lag_s) > max_lag_s - 0.02:
        text = f"IMU: its turn rates do not fit those between scans (correlation {best.correlation:.2f}); left as it is."
        return base.model_copy(update={"verdict": "contradicts", "correlation": best.correlation}), [
            *remarks,
            text,
        ]
    return _verdict(base, remarks, imu, R, axes, best, name, stood)


def _axes(every: list[Agreement], imu: Imu, R_base_imu: F8) -> tuple[F8, Agreement]:
    """The axes as given unless they are clearly wrong, else the simplest that fit as well as the best ones do.

    Several may: a vehicle that turns about one axis only does not tell the other two apart. Gravity then decides.
    """
    best = max(every, key=lambda a: a.correlation)
    if every[0].correlation >= MISFITS or best.correlation < FITS:
        return np.eye(3), every[0]
    limit = 1.0 - AS_GOOD * (1.0 - best.correlation**2)
    able = [a for a in every if a.correlation > 0 and a.correlation**2 >= limit]
    if not _upright(imu, R_base_imu, np.eye(3)):
        able = [a for a in able if _upright(imu, R_base_imu, a.axes)] or able
    proper = [a for a in able if np.linalg.det(a.axes) > 0] or able
    chosen = max(proper, key=lambda a: (round(float(np.trace(a.axes))), a.correlation))
    return chosen.axes, chosen


def _upright(imu: Imu, R_base_imu: F8, axes: F8) -> bool:
    T = np.eye(4)
    T[:3, :3] = R_base_imu @ axes
    return gravity_points_up(imu.accel_m_s2 * accel_unit(imu.accel_m_s2)[1], T)


def _unit(found: Agreement) -> str | None:
    for name, size in GYRO_UNITS.items():
        if abs(found.slope / size - 1.0) < UNIT_TOLERANCE:
            return name
    return None


def _verdict(
    base: ImuCheck, remarks: list[str], imu: Imu, R: F8, axes: F8, found: Agreement, unit: str, stood: bool
) -> tuple[ImuCheck, list[str]]:
    turned = not np.array_equal(axes, np.eye(3))
    offset = clear_offset(found)
    bias = np.zeros(3) if stood else _bias(found)
    accel_turned = turned and not _upright(imu, R, np.eye(3)) and np.linalg.det(axes) > 0
    if turned:
        remarks = [*remarks, f"IMU: its axes are not as declared ({_named(axes)}); corrected."]
    if unit != "rad/s":
        remarks = [*remarks, f"IMU: the gyro counts in {unit}; converted."]
    if bias.any():
        remarks = [
            *remarks,
            f"IMU: bias of the gyro from the scans, {np.degrees(np.linalg.norm(bias)):.2f} deg/s; removed.",
        ]
    remarks = [*remarks, said_of_clock("IMU", found, offset)]
    wrong = turned or unit != "rad/s" or offset != 0.0 or bool(bias.any()) or base.verdict == "corrected"
    return base.model_copy(
        update={
            "verdict": "corrected" if wrong else "agrees",
            "clock_offset_s": offset,
            "gyro_factor": GYRO_UNITS[unit],
            "gyro_axes": _tuples(axes),
            "gyro_bias_rad_s": tuple(bias.tolist()),
            "accel_axes": _tuples(axes if accel_turned else np.eye(3)),
            "measured_offset_s": found.lag_s,
            "measured_offset_std_s": found.lag_std_s,
            "correlation": found.correlation,
            "scan_pairs": found.pairs,
        }
    ), remarks


def _bias(found: Agreement) -> F8:
    """Constant by which the gyro differs from the scans, where it is clear; in the IMU's frame."""
    bias = -found.constant
    clear = np.linalg.norm(bias) > CLEAR_BIAS * found.noise / np.sqrt(found.pairs / 2)
    return bias if clear and np.all(np.abs(bias) < MAX_BIAS_RAD_S) else np.zeros(3)


def _tuples(M: F8) -> Matrix3:
    a, b, c = (tuple((row + 0.0).tolist()) for row in M)
    return a, b, c


def _named(axes: F8) -> str:
    """For instance `x = -y, y = x, z = z`."""
    names = []
    for own, row in zip("xyz", axes, strict=True):
        k = int(np.argmax(np.abs(row)))
        names.append(f"{own} = {'-' if row[k] < 0 else ''}{'xyz'[k]}")
    return ", ".join(names)
