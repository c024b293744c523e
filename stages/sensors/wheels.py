"""The wheel speed against the motion between scans: clock, unit, direction, scale."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.rig import WheelCheck
from scanloom.schemas.tracks import Wheel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.sensors.agreement import LEAST_PAIRS, STRAY, Readings, Seen, agree
from scanloom.stages.sensors.clock import clear_offset, said_of_clock

UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "cm/s": 0.01, "mm/s": 0.001}
UNIT_TOLERANCE = 0.1
FITS = 0.98
"""Correlation with the speed between scans; slip and wrong registrations stay below."""
MOVING_M_S = 0.5
LEAST_EXCITATION_M_S = 0.3
LEAST_SCALE_ERROR, CLEAR_SCALE, LARGEST_SCALE_STD = 0.004, 4.0, 0.005
STRETCH_GAP_S = 1.0
EITHER_WAY = np.array([[[1.0]], [[-1.0]]])


def check_wheel(wheel: Wheel, seen: Seen, max_lag_s: float) -> tuple[WheelCheck, list[str]]:
    """What to correct, and what to say; `seen` holds the speed (m, 1) of the wheels' place along x of the base, m/s."""
    if len(wheel) == 0:
        return WheelCheck(), []
    readings = Readings.of(wheel.stamp_ns, wheel.speed_m_s[:, None])
    usable = seen.take(readings.covers(seen.start_s - max_lag_s, seen.end_s + max_lag_s))
    moving = int((np.abs(usable.value[:, 0]) > MOVING_M_S).sum())
    if moving < LEAST_PAIRS:
        text = "Wheels: too few scans could be registered in motion to judge their unit and clock."
        return WheelCheck(verdict="unknown", scan_pairs=moving), [text]
    found = max(agree(usable, readings, EITHER_WAY, max_lag_s, biased=False), key=lambda a: a.correlation)
    lively = found.excitation > LEAST_EXCITATION_M_S and found.correlation > FITS
    lively = lively and abs(found.lag_s) < max_lag_s - 0.02
    offset = clear_offset(found) if lively else 0.0
    ratio, ratio_std = _ratio(usable, readings, offset)
    unit = next((n for n, size in UNITS.items() if abs(abs(ratio) / size - 1) < UNIT_TOLERANCE), None)
    check = WheelCheck(
        verdict="agrees", measured_ratio=ratio, measured_ratio_std=ratio_std, scan_pairs=moving
    )
    if unit is None or ratio_std > 0.1 * abs(ratio):
        text = f"Wheels: the scans move {ratio:.3f} times as fast, which is no known unit; left as they are."
        return check.model_copy(update={"verdict": "contradicts"}), [text]
    factor = float(np.sign(ratio)) * UNITS[unit]
    scale = _scale(ratio / factor, ratio_std / abs(factor))
    remarks = _remarks(unit, factor, scale)
    if lively:
        remarks.append(said_of_clock("Wheels", found, offset))
        check = check.model_copy(
            update={"measured_offset_s": found.lag_s, "measured_offset_std_s": found.lag_std_s}
        )
    wrong = factor != 1.0 or scale != 1.0 or offset != 0.0
    return check.model_copy(
        update={
            "verdict": "corrected" if wrong else "agrees",
            "factor": factor,
            "scale": scale,
            "clock_offset_s": offset,
        }
    ), remarks


def _ratio(seen: Seen, readings: Readings, lag_s: float) -> tuple[float, float]:
    """Speed of the scans over that of the wheels, and its deviation; pairs far from the median are left out."""
    told = readings.mean_over(seen.start_s + lag_s, seen.end_s + lag_s)[:, 0]
    speed: F8 = seen.value[:, 0]
    moving = np.abs(speed) > MOVING_M_S
    told, speed, start_s = told[moving], speed[moving], seen.start_s[moving]
    first = float(np.median(speed / np.where(told == 0, np.inf, told)))
    off = np.abs(speed - first * told)
    good = off <= STRAY * np.median(off) + 1e-9
    told, speed, start_s = told[good], speed[good], start_s[good]
    ratio, std = _slope(told, speed)
    stretch = np.cumsum(np.diff(start_s, prepend=start_s[:1]) > STRETCH_GAP_S)
    each = [_slope(told[stretch == k], speed[stretch == k])[0] for k in np.unique(stretch)]
    # Traffic beside the vehicle, or slip, makes a whole stretch wrong alike.
    spread = float(np.std(each)) / np.sqrt(max(len(each) - 1, 1))
    return ratio, float(np.hypot(std, spread))


def _slope(told: F8, speed: F8) -> tuple[float, float]:
    square = max(float(told @ told), 1e-12)
    ratio = float(speed @ told) / square
    return ratio, float(np.std(speed - ratio * told)) / float(np.sqrt(square))


def _scale(measured: float, std: float) -> float:
    """The measured scale where it is sure and not negligible; else one."""
    clear = std < LARGEST_SCALE_STD and abs(measured - 1) > max(CLEAR_SCALE * std, LEAST_SCALE_ERROR)
    return measured if clear else 1.0


def _remarks(unit: str, factor: float, scale: float) -> list[str]:
    said = []
    if unit != "m/s":
        said.append(f"Wheels: the speed is in {unit}; converted.")
    if factor < 0:
        said.append("Wheels: they count backwards; turned round.")
    if scale != 1.0:
        said.append(f"Wheels: the true speed is {scale:.4f} times theirs; corrected.")
    return said
