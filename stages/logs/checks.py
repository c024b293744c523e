"""What may be odd about a log: each check looks at one thing and says it in one sentence."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.session import Problem, Severity
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
GRAVITY_M_S2 = 9.80665
_YEAR_2001_NS = 1_000_000_000_000_000_000
_LABEL = {"lidar": "The LiDAR", "imu": "The IMU", "gnss": "The GNSS", "wheel": "The wheel speed"}
_SLOWEST_HZ = {"lidar": 4.0, "imu": 50.0, "gnss": 0.5, "wheel": 5.0}
_FASTEST_HZ = {"lidar": 41.0, "imu": 4000.0, "gnss": 200.0, "wheel": 2000.0}


def stamp_problems(role: str, topic: str, header_ns: I8, receive_ns: I8, start_ns: int) -> Iterator[Problem]:
    """Rate, gaps, backwards and duplicate stamps, header against receive time, clock jumps.

    Stamps are in the order of the log; `start_ns` is the start of the session, for "at 12.3 s".
    """
    if len(header_ns) < 2:
        return
    yield from _order(role, topic, header_ns, start_ns)
    yield from _pace(role, topic, np.unique(header_ns), start_ns)
    if not np.array_equal(header_ns, receive_ns):
        yield from _clock(role, topic, header_ns, receive_ns, start_ns)


def _order(role: str, topic: str, header_ns: I8, start_ns: int) -> Iterator[Problem]:
    steps = np.diff(header_ns)
    backwards, same = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0)
    if len(backwards):
        at = int(header_ns[backwards[0]])
        text = (
            f"has stamps that run backwards {_times(len(backwards))}, by up to {-steps.min() / 1e9:.3g} s, "
            f"first {_at(at, start_ns)}"
        )
        yield _problem(role, "backwards", "warning", text, topic, at)
    if len(same):
        at = int(header_ns[same[0]])
        text = f"has {_count(len(same), 'message')} with the stamp of the one before"
        yield _problem(role, "duplicate", "warning", text, topic, at)


def _pace(role: str, topic: str, stamps: I8, start_ns: int) -> Iterator[Problem]:
    if len(stamps) < 3:
        return
    steps = np.diff(stamps)
    period = float(np.median(steps))
    rate = 1e9 / period
    if not _SLOWEST_HZ[role] <= rate <= _FASTEST_HZ[role]:
        word = "slow" if rate < _SLOWEST_HZ[role] else "fast"
        yield _problem(role, "rate", "warning", f"comes at {rate:.3g} Hz, unusually {word}", topic)
    long = np.flatnonzero(steps > max(2.5 * period, period + 0.05e9))
    if len(long):
        worst = long[np.argmax(steps[long])]
        at, longest = int(stamps[worst]), float(steps[worst]) / 1e9
        missing = float((steps[long] / period - 1).sum())
        share = missing / (missing + len(stamps))
        severity: Severity = "warning" if longest > 0.5 or share > 0.01 else "info"
        text = (
            f"has {_count(len(long), 'gap')}; the longest lasts {longest:.2f} s, {_at(at, start_ns)}; "
            f"{100 * share:.2g} % of the measurements are missing"
        )
        yield _problem(role, "gap", severity, text, topic, at)


def _clock(role: str, topic: str, header_ns: I8, receive_ns: I8, start_ns: int) -> Iterator[Problem]:
    lag = (receive_ns - header_ns) / 1e9
    median = float(np.median(lag))
    if header_ns.max() < _YEAR_2001_NS < receive_ns.min():
        text = f"has headers that tell no date; they count from the sensor's start, {_span(header_ns.min() / 1e9)} before"
        yield _problem(role, "clock", "info", text, topic)
    elif abs(median) > 1.0:
        text = (
            f"is stamped by another clock than the recorder's: its headers are {_span(abs(median))} "
            f"{'behind' if median > 0 else 'ahead'}"
        )
        yield _problem(role, "clock", "info", text, topic)
    jumps = np.flatnonzero(np.abs(np.diff(lag)) > 0.5)
    kept = [i for i in jumps if _lasting(lag, int(i))]
    if kept:
        at = int(header_ns[kept[0]])
        size = float(lag[kept[0]] - lag[kept[0] + 1])
        text = f"has a clock that jumps {_times(len(kept))}, first by {size:+.3g} s {_at(at, start_ns)}"
        yield _problem(role, "clock_jump", "warning", text, topic, at)


def _lasting(lag: F8, i: int) -> bool:
    """A jump of the clock stays; a message that was merely late does not shift what follows."""
    before, after = np.median(lag[max(0, i - 4) : i + 1]), np.median(lag[i + 1 : i + 6])
    return bool(abs(after - before) > 0.5)


def imu_problems(imu: Imu, topic: str, R_base_imu: F8, mounting_known: bool) -> Iterator[Problem]:
    """Gravity on the wrong axis, gyro that looks like degrees. `imu` is in SI units."""
    if not len(imu):
        return
    mean = imu.accel_m_s2.mean(axis=0)
    norm = float(np.linalg.norm(mean))
    if not 8.0 < norm < 11.5:
        text = f"measures {norm:.2f} m/s2 on average where gravity is 9.81; its acceleration is of little use"
        yield _problem("imu", "gravity", "warning", text, topic)
    else:
        yield from _upright(R_base_imu @ mean / norm, topic, mounting_known)
    fast = float(np.percentile(np.linalg.norm(imu.gyro_rad_s, axis=1), 90))
    if fast > 7.0:
        text = f"turns at {fast:.0f} rad/s for a tenth of the time, which no vehicle does; the gyro may be in degrees per second"
        yield _problem("imu", "gyro_unit", "warning", text, topic)


def _upright(up: F8, topic: str, mounting_known: bool) -> Iterator[Problem]:
    if up[2] > 0.8:
        return
    axis = int(np.argmax(np.abs(up)))
    name = f"{'+' if up[axis] > 0 else '-'}{'xyz'[axis]}"
    frame = "the base" if mounting_known else "its own frame, and how it is mounted is not known"
    text = f"feels gravity along {name} of {frame}, where +z is expected; check ingest.imu_on_base"
    yield _problem("imu", "gravity_axis", "warning", text, topic)


def gnss_problems(gnss: Gnss, topic: str) -> Iterator[Problem]:
    """No fix, no covariance, a position that does not exist."""
    if not len(gnss):
        return
    fixed = (gnss.status >= 0) & np.isfinite(gnss.latitude_deg)
    if not fixed.any():
        yield _problem("gnss", "no_fix", "warning", "never has a fix; the map gets no georeference", topic)
        return
    share = 1 - fixed.mean()
    if share > 0.01:
        severity: Severity = "warning" if share > 0.5 else "info"
        yield _problem("gnss", "outage", severity, f"has no fix for {100 * share:.0f} % of the time", topic)
    variance = np.diagonal(gnss.covariance_m2[fixed], axis1=1, axis2=2)
    if not (variance > 0).any():
        yield _problem("gnss", "covariance", "info", "does not say how accurate it is", topic)


def _problem(role: str, code: str, severity: Severity, text: str, topic: str, stamp_ns: int = 0) -> Problem:
    sentence = f"{_LABEL[role]} ({topic}) {text}." if topic else f"{_LABEL[role]} {text}."
    return Problem(code=f"{role}.{code}", severity=severity, text=sentence, topic=topic, stamp_ns=stamp_ns)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}" + ("" if count == 1 else "s")


def _at(stamp_ns: int, start_ns: int) -> str:
    return f"at {(stamp_ns - start_ns) / 1e9:.1f} s"


def _span(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} minutes"
    if seconds < 172800:
        return f"{seconds / 3600:.0f} hours"
    return f"{seconds / 86400:.0f} days"
