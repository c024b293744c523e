"""One track's state, its prediction, and its update by the points that lie in its box.

Position and velocity follow a Kalman filter of constant velocity with white acceleration, in level axes of the
odometry; yaw and size have filters of their own. A box that turns out longer grows away from the side that is seen.
Source: methods 1.5.1, steps 3 and 4; Petrovskaya and Thrun 2009 for the anchored box.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects.shapes import bounds, direction, spreads
from scanloom.stages.objects.virtual_scan import ground_at

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

X, Y, VX, VY, P = 0, 1, 2, 3, 4
"""Position m, velocity m/s; from P on their covariance, row by row."""
YAW, YAW_VAR, LENGTH, WIDTH, HEIGHT, FOOT = 20, 21, 22, 23, 24, 25
LENGTH_KNOWN, WIDTH_KNOWN = 26, 27
"""How often both ends of it were seen."""
HITS, MISSED_S = 28, 29
PROVEN = 30
"""1 once it is proven that it drove."""
STATE = 31

MEASURED_X, MEASURED_Y, R_XX, R_XY, R_YY, GROWS_U, GROWS_V, POINTS, UPRIGHT = 0, 1, 2, 3, 4, 5, 6, 7, 8
"""What an update saw: the middle of the box, its covariance, where the box grows to (1 forward, -1 back, 0 neither), how
many points, and how far these reach upwards, m."""
SEEN = 9

ACCELERATION_M_S2 = 4.0
YAW_RATE_VAR = 0.05
FIRST_SPEED_M_S = 12.0
SMALL_M = 1.1
"""What is no larger than this has no direction of its own."""
USUAL = (4.3, 1.8)
"""Length and width of a car of which one end or one side is seen, m."""
UNSEEN_M = 4.0
SHARP_M = 0.4
"""Ends seen less sharply do not tell the size."""
SURE, GROWTH, LARGE_GROWTH = 5.0, 0.005, 0.03
"""A size that was seen so often grows by no more than this share from one scan to the next; a large one by the other."""
LARGE_M = 2.4
PIECE, LEAST_VEHICLE = 0.8, (2.4, 1.2)
"""What is shorter than this share of a vehicle is a piece of it, if its size is known or no vehicle is so small, m."""
GATE = 25.0
"""A measurement farther off, in squared standard deviations, is of something else."""
MOVING_M_S, SURE_M_S = 2.0, 1.5


@kernel
def predict(state: F8, dt: float) -> None:
    """Move all tracks (m, STATE) on by dt, s."""
    q = ACCELERATION_M_S2 * ACCELERATION_M_S2
    F = np.eye(4)
    F[0, 2] = F[1, 3] = dt
    Q = np.zeros((4, 4))
    for k in range(2):
        Q[k, k] = q * dt**4 / 4
        Q[k, k + 2] = Q[k + 2, k] = q * dt**3 / 2
        Q[k + 2, k + 2] = q * dt**2
    for m in range(len(state)):
        row = state[m]
        row[X] += dt * row[VX]
        row[Y] += dt * row[VY]
        C = row[P : P + 16].copy().reshape(4, 4)
        row[P : P + 16] = (F @ C @ F.T + Q).ravel()
        row[YAW_VAR] = min(row[YAW_VAR] + YAW_RATE_VAR * dt, 1.0)
        row[MISSED_S] += dt


@kernel
def start(points: F4, origin: F8, ground: F4, row: F8) -> None:
    """The state of a new track from its first points (k, 4) around the LiDAR."""
    row[:] = 0.0
    yaw = direction(points, 0.25 * np.pi, 0.25 * np.pi, 22)
    sides = bounds(points, yaw)
    along, across = sides[1] - sides[0], sides[3] - sides[2]
    broad = max(along, across)
    if SMALL_M < broad < 2.7:  # an end of a car: it is long the other way
        turn = along >= across
    else:
        turn = along < across
    if turn:
        yaw += 0.5 * np.pi
        sides = bounds(points, yaw)
        along, across = sides[1] - sides[0], sides[3] - sides[2]
    row[YAW], row[YAW_VAR] = yaw, 0.3 if broad > SMALL_M else 1.0
    row[LENGTH], row[WIDTH] = max(along, 0.4), max(across, 0.4)
    if broad > SMALL_M:
        row[LENGTH], row[WIDTH] = max(along, USUAL[0]), max(across, USUAL[1])
    u, _ = _middle(sides[0], sides[1], row[LENGTH])
    v, _ = _middle(sides[2], sides[3], row[WIDTH])
    c, s = np.cos(yaw), np.sin(yaw)
    row[X], row[Y] = origin[0] + c * u - s * v, origin[1] + s * u + c * v
    for k in range(2):
        row[P + 5 * k] = 0.5
        row[P + 5 * (k + 2)] = FIRST_SPEED_M_S**2
    _stand(points, origin, ground, row)
    row[HITS] = 0.0


@kernel
def _middle(low: float, high: float, size: float) -> tuple[float, float]:
    """Where the middle of a box is of which the near side is seen, and the side to which it grows (1 or -1)."""
    if abs(low) < abs(high):
        return low + 0.5 * size, 1.0
    return high - 0.5 * size, -1.0


@kernel
def _stand(points: F4, origin: F8, ground: F4, row: F8) -> float:
    """Foot on the ground, height of the highest point; returns how far the points reach upwards, m."""
    foot = origin[2] + ground_at(ground, row[X] - origin[0], row[Y] - origin[1])
    top, low = -np.inf, np.inf
    for n in range(len(points)):
        top, low = max(top, origin[2] + points[n, 2]), min(low, origin[2] + points[n, 2])
    row[FOOT] = foot if row[HITS] == 0.0 else row[FOOT] + 0.3 * (foot - row[FOOT])
    row[HEIGHT] = max(row[HEIGHT], top - row[FOOT])
    return top - low


@kernel
def update(
    points: F4, origin: F8, ground: F4, starts: I4, returns: F4, step_rad: float, row: F8, seen: F8
) -> None:
    """Correct a track by its points (k, 4) around the LiDAR; `seen` (SEEN,) takes what was measured."""
    _turn(points, row)
    sides = bounds(points, row[YAW])
    spread = spreads(points, row[YAW], sides, starts, returns, step_rad)
    if max(row[LENGTH], row[WIDTH]) <= SMALL_M and max(sides[1] - sides[0], sides[3] - sides[2]) <= SMALL_M:
        spread[:] = np.minimum(spread, 0.2)
    c, s = np.cos(row[YAW]), np.sin(row[YAW])
    x, y = row[X] - origin[0], row[Y] - origin[1]
    here = np.array([c * x + s * y, c * y - s * x])
    moved, measured, variance, grows = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for axis in range(2):
        measured[axis], variance[axis], grows[axis], moved[axis] = _along(
            row, axis, here[axis], sides, spread
        )
    row[X] += c * moved[0] - s * moved[1]
    row[Y] += s * moved[0] + c * moved[1]
    seen[MEASURED_X] = origin[0] + c * measured[0] - s * measured[1]
    seen[MEASURED_Y] = origin[1] + s * measured[0] + c * measured[1]
    seen[R_XX] = c * c * variance[0] + s * s * variance[1]
    seen[R_XY] = c * s * (variance[0] - variance[1])
    seen[R_YY] = s * s * variance[0] + c * c * variance[1]
    seen[GROWS_U], seen[GROWS_V], seen[POINTS] = grows[0], grows[1], len(points)
    if not _correct(row, seen):
        seen[:] = 0.0
        return
    seen[UPRIGHT] = _stand(points, origin, ground, row)
    row[HITS] += 1.0
    row[MISSED_S] = 0.0


@kernel
def _along(row: F8, axis: int, here: float, sides: F8, spread: F8) -> tuple[float, float, float, float]:
    """Along one axis: the middle that was measured, its variance, where the box grows to, how the old middle moved by growing."""
    low, high = sides[2 * axis], sides[2 * axis + 1]
    s_low, s_high = spread[2 * axis], spread[2 * axis + 1]
    size, known = row[LENGTH + axis], row[LENGTH_KNOWN + axis]
    whole = np.isfinite(s_low) and np.isfinite(s_high)
    seen = high - low
    growth = 1.0 + (LARGE_GROWTH if max(row[LENGTH], row[WIDTH]) > LARGE_M else GROWTH)
    piece = row[PROVEN] > 0.0 and seen < PIECE * size and (known >= SURE or seen < LEAST_VEHICLE[axis])
    if piece:
        new = size
    elif whole and max(s_low, s_high) < SHARP_M:
        blend = 1.0 / min(known + 1.0, 10.0) if seen < size or known == 0.0 else 0.5
        new = size + blend * (seen - size)
        if known >= SURE:
            new = min(new, size * growth)
        row[LENGTH_KNOWN + axis] = known + 1.0
    else:
        new = max(size, seen if known < SURE else min(seen, size * growth))
    grows = 0.0
    if s_low < s_high:
        grows = 1.0
    elif s_high < s_low:
        grows = -1.0
    elif abs(low + high) > 0.0 and not whole:
        grows = 1.0 if abs(low) < abs(high) else -1.0
    moved = 0.5 * grows * (new - size)
    row[LENGTH + axis] = new
    here += moved
    if not np.isfinite(s_low) and not np.isfinite(s_high):
        pushed = min(max(here, high - 0.5 * new), low + 0.5 * new)
        return pushed, UNSEEN_M**2 if pushed == here else 0.5, grows, moved
    if whole and known >= SURE and not 0.5 * size < seen < size + 0.7:  # a piece of it, or more than it
        return here, max(0.5 * abs(size - seen), 0.5) ** 2, grows, moved
    weight_low = 1.0 / (s_low * s_low)
    weight_high = 1.0 / (s_high * s_high)
    middle = (weight_low * (low + 0.5 * new) + weight_high * (high - 0.5 * new)) / (weight_low + weight_high)
    return middle, 1.0 / (weight_low + weight_high) + 0.003, grows, moved


@kernel
def _turn(points: F4, row: F8) -> None:
    """Correct the yaw by the shape, and by the velocity once it is known."""
    speed = np.hypot(row[VX], row[VY])
    if speed > MOVING_M_S and row[HITS] >= 4.0 and row[P + 10] + row[P + 15] < SURE_M_S**2:
        heading = np.arctan2(row[VY], row[VX])
        off = heading - row[YAW]
        quarter = np.round(off / (0.5 * np.pi))
        if int(quarter) % 2 != 0 and max(row[LENGTH], row[WIDTH]) > SMALL_M:
            row[YAW] += 0.5 * np.pi
            row[LENGTH], row[WIDTH] = row[WIDTH], row[LENGTH]
            row[LENGTH_KNOWN], row[WIDTH_KNOWN] = row[WIDTH_KNOWN], row[LENGTH_KNOWN]
        off = heading - row[YAW]
        off -= np.pi * np.round(off / np.pi)
        variance = 0.5 * (row[P + 10] + row[P + 15]) / (speed * speed) + 0.02
        _yaw(row, off, variance)
    sides = bounds(points, row[YAW])
    broad = max(sides[1] - sides[0], sides[3] - sides[2])
    if broad > SMALL_M and len(points) >= 8:
        reach = min(max(3.0 * np.sqrt(row[YAW_VAR]), 0.05), 0.25 * np.pi)
        yaw = direction(points, row[YAW], reach, 10)
        error = 0.03 + 0.15 / broad**2
        _yaw(row, yaw - row[YAW], error * error)


@kernel
def _yaw(row: F8, off: float, variance: float) -> None:
    gain = row[YAW_VAR] / (row[YAW_VAR] + variance)
    row[YAW] += gain * off
    row[YAW_VAR] *= 1.0 - gain


@kernel
def _correct(row: F8, seen: F8) -> bool:
    """Kalman update of position and velocity by a measured position; False where it is too far off to be the same thing."""
    C = row[P : P + 16].copy().reshape(4, 4)
    a, b, d = C[0, 0] + seen[R_XX], C[0, 1] + seen[R_XY], C[1, 1] + seen[R_YY]
    determinant = a * d - b * b
    inverse = np.array([[d, -b], [-b, a]]) / determinant
    gain = np.ascontiguousarray(C[:, :2]) @ inverse
    off = np.array([seen[MEASURED_X] - row[X], seen[MEASURED_Y] - row[Y]])
    if off @ inverse @ off > GATE:
        return False
    row[:4] += gain @ off
    C -= gain @ np.ascontiguousarray(C[:2, :])
    row[P : P + 16] = (0.5 * (C + C.T)).ravel()
    return True
