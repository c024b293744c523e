"""One turn of a spinning LiDAR: when each point was measured, and which beam measured it, from angles alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel

TURN = 2 * np.pi
CLOCKWISE, COUNTER_CLOCKWISE = -1, 1
LARGEST_STEP_RAD = np.radians(20.0)
"""Mean azimuth step from point to point in firing order; beams of one direction differ by a few degrees."""
REAR_RAD = np.pi
"""Where a sweep starts when nothing tells: behind the vehicle, as drivers and data sets cut it."""


class Sweep(NamedTuple):
    """How a LiDAR turned during one sweep."""

    direction: int
    """-1 clockwise seen from above, +1 counter-clockwise."""
    seam_rad: float
    """Azimuth at which the sweep starts and ends, counter-clockwise from x."""
    in_firing_order: bool
    """The points are stored in the order measured, all beams of one direction together."""
    detected: bool
    """False when the order of the points tells nothing and defaults were taken."""


@kernel
def _azimuth(y: float, x: float) -> float:
    """atan2 within 4e-6 rad (0.06 us of a turn of 0.1 s): minimax polynomial of odd degree 11 on [0, 1]."""
    ax, ay = abs(x), abs(y)
    big = max(ax, ay)
    if big == 0.0:
        return 0.0
    a = min(ax, ay) / big
    s = a * a
    r = a * (
        0.99997726
        + s * (-0.33262347 + s * (0.19354346 + s * (-0.11643287 + s * (0.05265332 + s * -0.01172120))))
    )
    if ay > ax:
        r = 0.5 * np.pi - r
    if x < 0.0:
        r = np.pi - r
    return -r if y < 0.0 else r


@kernel
def _wrap(angle: float) -> float:
    """Into [-pi, pi]; for arguments within two turns."""
    if angle > np.pi:
        return angle - 2 * np.pi
    if angle < -np.pi:
        return angle + 2 * np.pi
    return angle


@kernel
def _progress(x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[float, float, float, int]:
    """Sum of the azimuth steps from point to point and of their sizes, rad, first azimuth, number of steps."""
    total, size, first, last = 0.0, 0.0, 0.0, 0.0
    count = 0
    for i in range(len(x)):
        if not (abs(x[i]) + abs(y[i]) > 0.0):
            continue
        azimuth = _azimuth(y[i], x[i])
        if count == 0:
            first = azimuth
        else:
            step = _wrap(azimuth - last)
            total += step
            size += abs(step)
        last = azimuth
        count += 1
    return total, size, first, max(count - 1, 0)


@kernel
def _phase_in_order(
    x: NDArray[np.float32], y: NDArray[np.float32], direction: int, period_ns: float, out: NDArray[np.int64]
) -> None:
    """Time from the azimuth unrolled along the order of the points, so that no point jumps by a turn at the seam."""
    started = False
    unrolled, lowest = 0.0, 0.0
    scale = period_ns / (2 * np.pi)
    for i in range(len(x)):
        if not (abs(x[i]) + abs(y[i]) > 0.0):
            out[i] = np.int64(max(unrolled, 0.0) * scale)
            continue
        azimuth = direction * _azimuth(y[i], x[i])
        if not started:
            started = True
            lowest = azimuth
        else:
            step = (azimuth - lowest - unrolled) % (2 * np.pi)
            unrolled += _wrap(step)
        out[i] = np.int64(min(max(unrolled * scale, 0.0), period_ns - 1.0))


@kernel
def _phase_from_seam(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    direction: int,
    seam: float,
    period_ns: float,
    out: NDArray[np.int64],
) -> None:
    """Time from the angle between the seam and the point, in the direction of rotation."""
    scale = period_ns / (2 * np.pi)
    for i in range(len(x)):
        turned = direction * (_azimuth(y[i], x[i]) - seam)
        if turned < 0.0:
            turned += 2 * np.pi
        if turned < 0.0:
            turned += 2 * np.pi
        if turned >= 2 * np.pi:
            turned -= 2 * np.pi
        time = turned * scale
        out[i] = np.int64(min(time, period_ns - 1.0)) if time >= 0.0 else np.int64(0)


def detect_sweep(x: NDArray[np.float32], y: NDArray[np.float32]) -> Sweep:
    """How the LiDAR turned, from the order of the points.

    Parameters
    ----------
    x, y : (n,) coordinates in the LiDAR's frame, m, in the order of the log; NaN and zero points are skipped.

    Azimuth steps from point to point telescope: about one turn in all, in small steps, means points in firing order;
    several turns with hardly a step back mean one beam after the other. The sign is the direction, the first point the
    seam. Any other order (shuffled, filtered) tells nothing: clockwise from the rear is taken.
    """
    total, size, first, steps = _progress(x, y)
    turns = abs(total) / TURN
    direction = COUNTER_CLOCKWISE if total > 0 else CLOCKWISE
    if steps > 0 and 0.6 < turns < 1.6 and size / steps < LARGEST_STEP_RAD:
        return Sweep(direction, first, in_firing_order=True, detected=True)
    if turns >= 1.6 and abs(total) > 0.8 * size:
        return Sweep(direction, first, in_firing_order=False, detected=True)
    return Sweep(CLOCKWISE, REAR_RAD, in_firing_order=False, detected=False)


def reaches_around(x: NDArray[np.float32], y: NDArray[np.float32]) -> bool:
    """Whether the points lie all around the sensor: in at least 27 of 36 sectors."""
    sample = slice(None, None, max(1, len(x) // 4000))
    with np.errstate(invalid="ignore"):
        azimuth = np.arctan2(y[sample], x[sample])
    hit = np.isfinite(azimuth) & ((x[sample] != 0) | (y[sample] != 0))
    sectors = np.unique(((azimuth[hit] + np.pi) * (36 / TURN)).astype(int) % 36)
    return len(sectors) >= 27


def sweep_times(
    x: NDArray[np.float32], y: NDArray[np.float32], period_ns: int, sweep: Sweep
) -> NDArray[np.int64]:
    """Time (n,) since the start of the sweep, ns in [0, period_ns), of points that carry none.

    Parameters
    ----------
    x, y : (n,) coordinates in the LiDAR's frame, m. Points at the origin or NaN get a time of no meaning.
    period_ns : duration of one turn.
    sweep : from `detect_sweep`, or as known for the data set.
    """
    out = np.zeros(len(x), np.int64)
    if sweep.in_firing_order:
        _phase_in_order(x, y, sweep.direction, float(period_ns), out)
    else:
        _phase_from_seam(x, y, sweep.direction, sweep.seam_rad, float(period_ns), out)
    return out


@kernel
def _rows_by_wrap(x: NDArray[np.float32], y: NDArray[np.float32], least: int, out: NDArray[np.uint16]) -> int:
    """Number of the row of each point: a new row where the azimuth in [0, 2 pi) falls by more than half a turn.

    That is from the right (y < 0) to the left, by more than half a turn clockwise: nowhere else it need be computed.
    """
    row, since = 0, 0
    for i in range(len(x)):
        if i > 0 and since >= least and y[i - 1] < 0.0 and not y[i] < 0.0:
            fall = _azimuth(y[i - 1], x[i - 1]) + 2 * np.pi - _azimuth(y[i], x[i])
            if fall > np.pi:
                row += 1
                since = 0
        since += 1
        out[i] = row
    return row + 1 if len(x) > 0 else 0


def rings_by_wrap(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], *, beams: int | None = None
) -> NDArray[np.uint16]:
    """Beam (n,), 0 the lowest, of points stored beam by beam (KITTI's `.bin`); 0 throughout where they are not.

    Each beam is stored as one turn of rising azimuth from straight ahead, so a new one begins where the azimuth falls
    back. The order of the beams, from above or from below, is read from the elevation.

    Parameters
    ----------
    x, y, z : (n,) coordinates in the LiDAR's frame, m.
    beams : number of beams when known (64 for KITTI), so that a lost row does not shift the others from above.
    """
    row = np.zeros(len(x), np.uint16)
    count = _rows_by_wrap(x, y, max(16, len(x) // 2000), row)
    if not 4 <= count <= 260:
        return np.zeros(len(x), np.uint16)
    last = max(count, beams or 0) - 1
    if beams is not None:
        row = np.minimum(row, np.uint16(beams - 1))
        last = beams - 1
    sample = slice(None, None, max(1, len(x) // 4000))
    trend = elevation_trend(x[sample], y[sample], z[sample], row[sample].astype(np.int64))
    if abs(trend) < 0.5:
        return np.zeros(len(x), np.uint16)
    return row if trend > 0 else np.uint16(last) - row


def elevation_trend(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], number: NDArray[np.int64]
) -> float:
    """Correlation of elevation with a beam number: near 1 lowest first, near -1 highest first, else no order."""
    flat = np.hypot(x.astype(float), y.astype(float))
    with np.errstate(invalid="ignore", divide="ignore"):
        elevation = np.arctan2(z.astype(float), flat)
    good = np.isfinite(elevation) & (flat > 0)
    if good.sum() < 8 or np.ptp(number[good]) == 0 or np.ptp(elevation[good]) == 0:
        return 0.0
    return float(np.corrcoef(elevation[good], number[good])[0, 1])
