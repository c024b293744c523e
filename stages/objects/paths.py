"""A track as a whole, once it has ended: one size for all its boxes, a smooth path, and whether and when it moved.

Boxes are laid out again with the final size, from the side that was seen, so that a box of which more was seen later
does not seem to move. What stands before it moves is dynamic from the first scan on; what stands to the end of its track
for longer than `parked_s` is not dynamic once it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.objects import ObjectClass
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects import filter as kalman
from scanloom.stages.objects.proof import denies_moving, says_moving
from scanloom.stages.objects.settings import Settings
from scanloom.stages.objects.tracker import AGES_S, MOVED_M, History

B1 = NDArray[np.bool_]

SEEN = kalman.STATE
FULL_TURN = 2.0 * np.pi
HEADING_M_S = 1.0
REST_M, REST_SHARE, MOST_REST_M = 0.5, 0.2, 1.0
"""What rests seems to wander by the first, or by that share of its length up to the last: of a vehicle a few points show now
one end, now the other."""
MANY_SCANS = 15
UPRIGHT_M = 0.4
"""Things stand upright: rings of the sensor on the ground, which run along with the vehicle, do not."""
SIZE_QUANTILE, SMALL_QUANTILE = 0.7, 0.25
WIDEST_M, NARROWEST_M, VEHICLE_M = 2.9, 1.6, 2.6
"""Vehicles, which are longer than the last, are at most and at least so wide."""
STEADY_ROWS = 10
"""Places are averaged over so many scans before it is asked how far they are apart: what wanders about does not move."""
TOP_MARGIN_M = 0.1
LARGE_WIDTH_M, CUT_M, HIGHER_M = 2.1, 2.0, 0.8
"""The highest points of lorries and buses are not used: those that reach so far up are taken to be higher by the last."""
PERSON_M, CYCLIST_M, CYCLIST_WIDTH_M, TRUCK_M = 1.1, 2.4, 1.2, 6.5
PERSON_M_S = 3.0


@dataclass(frozen=True)
class ObjectPath:
    """Boxes of one track in level axes of the odometry, one per scan from its first to its last."""

    rows: NDArray[np.int64]
    """(n,) rows of the odometry."""
    xyz: F8
    """(n, 3) middle of the foot, m."""
    yaw: F8
    size: F8
    """(3,) length, width, height, m."""
    speed_m_s: F8
    dynamic: B1
    kind: ObjectClass
    score: float


def object_path(settings: Settings, history: History, scan_index: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> ObjectPath | None:  # fmt: skip
    """The path of a track that moved, or None; scans and their stamps are those of the odometry."""
    moving = says_moving(np.array(history.asked))
    if np.count_nonzero(moving) < settings.min_scans:
        return None
    seen = _upright(np.array(history.rows))
    if np.count_nonzero(seen[:, SEEN + kalman.UPRIGHT] >= UPRIGHT_M) < settings.min_scans:
        return None
    size = _final_size(seen)
    if min(size[:2]) > WIDEST_M:
        return None
    first, last = np.searchsorted(scan_index, [history.scans[0], history.scans[-1]])
    rows = np.arange(first, last + 1)
    place = np.searchsorted(scan_index, history.scans) - first
    t = (stamp_ns[rows] - stamp_ns[first]) * 1e-9
    measured, R = _measured(seen, size, place, len(rows))
    path, variance = smooth(t, measured, R)
    displaced = _displaced(t, path)[place]
    score = 1.0 if seen[-1, kalman.PROVEN] else _score(np.array(history.asked)[displaced])
    enough = np.count_nonzero(moving & displaced) >= settings.min_scans and score >= settings.min_score
    if not enough or not _moved(settings, path, variance):
        return None
    speed = np.hypot(path[:, 2], path[:, 3])
    yaw = _yaw(seen[:, kalman.YAW], place, path, speed, size)
    z = np.interp(t, t[place], seen[:, kalman.FOOT])
    return ObjectPath(
        rows=rows,
        xyz=np.column_stack((path[:, :2], z)),
        yaw=yaw,
        size=size,
        speed_m_s=speed,
        dynamic=dynamic_rows(settings, t, path, _rest_m(size)),
        kind=_kind(size, speed),
        score=score,
    )


def _score(asked: NDArray[np.int64]) -> float:
    """Share of places that were seen to be empty, or of scans that found most of them so where many did: a few scans in
    which a box grew by metres ask of many places that it never left."""
    through, taken, _ = asked.T
    says, denies = int(says_moving(asked).sum()), int(denies_moving(asked).sum())
    places = through.sum() / max(through.sum() + taken.sum(), 1)
    return float(max(places, says / max(says + denies, 1)) if says >= MANY_SCANS else places)


def _displaced(t: F8, path: F8) -> B1:
    """Where (n,) the path has led away from where it was some seconds before: elsewhere free space was asked because the
    box wandered while its size became known."""
    places = np.stack([path[np.searchsorted(t, t - age), :2] for age in (0.0, *AGES_S)])
    low, high = places.min(axis=0), places.max(axis=0)
    return np.asarray(np.hypot(*(high - low).T) > MOVED_M)


def _upright(rows: F8) -> F8:
    """The rows with the axes that the track had in the end, where they were once turned by a quarter."""
    out = rows.copy()
    quarters = np.round(np.diff(out[:, kalman.YAW]) / (0.5 * np.pi)).astype(int)
    owed = np.concatenate((np.cumsum(quarters[::-1])[::-1], [0]))
    odd = owed % 2 != 0
    out[:, kalman.YAW] += 0.5 * np.pi * owed
    for pair in ([kalman.LENGTH, kalman.WIDTH], [kalman.LENGTH_KNOWN, kalman.WIDTH_KNOWN]):
        out[np.ix_(odd, pair)] = out[np.ix_(odd, pair[::-1])]
    grows = out[:, [SEEN + kalman.GROWS_U, SEEN + kalman.GROWS_V]]
    for turned in range(4):
        at = owed % 4 == turned
        u, v = grows[at, 0], grows[at, 1]
        out[at, SEEN + kalman.GROWS_U] = (u, v, -u, -v)[turned]
        out[at, SEEN + kalman.GROWS_V] = (v, -u, -v, u)[turned]
    return out


def _final_size(rows: F8) -> F8:
    """Length, width and height of the box as the track knew them; what is wider than vehicles are took in what it passed,
    and is as large as it was without."""
    sides = _sides(rows, SIZE_QUANTILE)
    if min(sides) > WIDEST_M:
        sides = _sides(rows, SMALL_QUANTILE)
    if max(sides) > VEHICLE_M:
        shorter = int(sides[1] < sides[0])
        sides[shorter] = max(sides[shorter], NARROWEST_M)
    top = rows[:, kalman.HEIGHT].max() + TOP_MARGIN_M
    large = max(sides) > TRUCK_M or (max(sides) > VEHICLE_M and min(sides) > LARGE_WIDTH_M)
    cut = large and top >= CUT_M
    return np.array([*sides, top + HIGHER_M if cut else top])


def _sides(rows: F8, quantile: float) -> list[float]:
    sides = []
    for size, known in ((kalman.LENGTH, kalman.LENGTH_KNOWN), (kalman.WIDTH, kalman.WIDTH_KNOWN)):
        seen = rows[rows[:, known] >= 2.0, size]
        sides.append(float(np.quantile(seen, quantile) if len(seen) >= 3 else rows[-1, size]))
    return sides


def _measured(rows: F8, size: F8, place: NDArray[np.int64], count: int) -> tuple[F8, F8]:
    """Middles (count, 2) of a box of the final size, NaN where it was not seen, and their covariances (count, 2, 2)."""
    grow = 0.5 * (size[:2] - rows[:, [kalman.LENGTH, kalman.WIDTH]])
    u = grow[:, 0] * rows[:, SEEN + kalman.GROWS_U]
    v = grow[:, 1] * rows[:, SEEN + kalman.GROWS_V]
    c, s = np.cos(rows[:, kalman.YAW]), np.sin(rows[:, kalman.YAW])
    middle = np.full((count, 2), np.nan)
    middle[place, 0] = rows[:, SEEN + kalman.MEASURED_X] + c * u - s * v
    middle[place, 1] = rows[:, SEEN + kalman.MEASURED_Y] + s * u + c * v
    R = np.tile(np.eye(2), (count, 1, 1))
    R[place, 0, 0], R[place, 1, 1] = rows[:, SEEN + kalman.R_XX], rows[:, SEEN + kalman.R_YY]
    R[place, 0, 1] = R[place, 1, 0] = rows[:, SEEN + kalman.R_XY]
    return middle, R


@kernel
def smooth(t: F8, measured: F8, R: F8) -> tuple[F8, F8]:
    """Rauch-Tung-Striebel smoother of constant velocity: states (n, 4) and variances (n, 4) at times t, s, from places
    (n, 2), NaN where there is none, and their covariances (n, 2, 2)."""
    n = len(t)
    x, C = np.zeros((n, 4)), np.zeros((n, 4, 4))
    ahead, D = np.zeros((n, 4)), np.zeros((n, 4, 4))
    q = kalman.ACCELERATION_M_S2**2
    x[0, :2] = measured[0]
    C[0] = np.diag(np.array([R[0, 0, 0], R[0, 1, 1], kalman.FIRST_SPEED_M_S**2, kalman.FIRST_SPEED_M_S**2]))
    for k in range(1, n):
        F, Q = _step(t[k] - t[k - 1], q)
        ahead[k] = F @ x[k - 1]
        D[k] = F @ C[k - 1] @ F.T + Q
        x[k], C[k] = ahead[k], D[k]
        if np.isfinite(measured[k, 0]):
            gain = np.ascontiguousarray(D[k][:, :2]) @ np.linalg.inv(D[k][:2, :2] + R[k])
            x[k] = x[k] + gain @ (measured[k] - ahead[k, :2])
            C[k] = C[k] - gain @ np.ascontiguousarray(D[k][:2, :])
    for k in range(n - 2, -1, -1):
        F, _ = _step(t[k + 1] - t[k], q)
        G = C[k] @ F.T @ np.linalg.inv(D[k + 1])
        x[k] = x[k] + G @ (x[k + 1] - ahead[k + 1])
        C[k] = C[k] + G @ (C[k + 1] - D[k + 1]) @ G.T
    variance = np.empty((n, 4))
    for k in range(n):
        variance[k] = np.diag(C[k])
    return x, variance


@kernel
def _step(dt: float, q: float) -> tuple[F8, F8]:
    F, Q = np.eye(4), np.zeros((4, 4))
    for k in range(2):
        F[k, k + 2] = dt
        Q[k, k] = q * dt**4 / 4
        Q[k, k + 2] = Q[k + 2, k] = q * dt**3 / 2
        Q[k + 2, k + 2] = q * dt**2
    return F, Q


def _moved(settings: Settings, path: F8, variance: F8) -> bool:
    """Whether the path leads farther than its uncertainty explains."""
    window = min(STEADY_ROWS, max(len(path) // 3, 1))
    weight = np.full(window, 1.0 / window)
    steady = np.column_stack([np.convolve(path[:, k], weight, mode="valid") for k in range(2)])
    way = steady.max(axis=0) - steady.min(axis=0)
    sigma = float(np.sqrt(np.median(variance[:, :2].max(axis=1))))
    return float(np.hypot(*way)) > max(settings.min_displacement_m, settings.min_sigmas * sigma)


def _yaw(seen: F8, place: NDArray[np.int64], path: F8, speed: F8, size: F8) -> F8:
    """Yaw (n,) of the box: that of its shape, turned to where it drives; small things look where they go."""
    n = len(path)
    heading = np.unwrap(np.arctan2(path[:, 3], path[:, 2]))
    fast = speed > HEADING_M_S
    if size[:2].max() <= PERSON_M:
        going = np.flatnonzero(fast if fast.any() else speed >= speed.max())
        return np.asarray(np.interp(np.arange(n), going, np.unwrap(heading[going])))
    yaw = np.interp(np.arange(n), place, np.unwrap(seen, period=np.pi))
    forward = np.sum(speed * np.cos(heading - yaw))
    return yaw if forward >= 0.0 else yaw + np.pi


def _rest_m(size: F8) -> float:
    return min(max(REST_M, REST_SHARE * float(size[:2].max())), MOST_REST_M)


def dynamic_rows(settings: Settings, t: F8, path: F8, rest_m: float = REST_M) -> B1:
    """All rows but those after it came to rest for good: where a path (n, 2 or more) of times t, s, stays within `rest_m`
    to its end."""
    rest = np.median(path[t >= t[-1] - settings.parked_s, :2], axis=0)
    apart = np.hypot(*(path[:, :2] - rest).T)
    last = int(np.flatnonzero(apart > rest_m).max(initial=0))
    moving = np.ones(len(t), bool)
    if t[-1] - t[last] > settings.parked_s:
        moving[last + 1 :] = False
    return moving


def _kind(size: F8, speed: F8) -> ObjectClass:
    long, wide = max(size[0], size[1]), min(size[0], size[1])
    if long <= PERSON_M:
        return ObjectClass.PERSON if np.quantile(speed, 0.8) < PERSON_M_S else ObjectClass.CYCLIST
    if long <= CYCLIST_M and wide <= CYCLIST_WIDTH_M:
        return ObjectClass.CYCLIST
    return ObjectClass.TRUCK if long > TRUCK_M else ObjectClass.VEHICLE
