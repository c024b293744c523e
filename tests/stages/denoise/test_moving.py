"""What moves, on streets with exact truth: things that pass are named, things that stand are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings, denoise
from scanloom.stages.geometry.se3 import F8, pose, transform
from tests.stages.denoise.test_stage import make_session
from tests.worlds import GROUND_Z_M, BoxWorld, observe, street

PERIOD_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
COUNT = 19
MIDDLE = COUNT // 2
ONLY_MOVING = Settings(particles=False)

B1 = NDArray[np.bool_]
Box = Callable[[float], F8]
"""Lower and upper corner (2, 3), m, of a thing at a time, s."""


def thing(size: tuple[float, float, float], at: Callable[[float], tuple[float, float]]) -> Box:
    def box(t: float) -> F8:
        x, y = at(t)
        length, width, height = size
        low = [x - length / 2, y - width / 2, GROUND_Z_M + 0.2]
        return np.array([low, [low[0] + length, low[1] + width, low[2] + height]])

    return box


CAR, PERSON = (4.3, 1.8, 1.4), (0.5, 0.5, 1.7)


def drive(
    things: list[Box], speed_m_s: float, rows: int = 32, columns: int = 512
) -> tuple[list[DeskewedScan], F8]:
    """Scans along a street with things in it, and the true poses."""
    rng = np.random.default_rng(3)
    scans, poses = [], []
    for k in range(COUNT):
        t = (k - MIDDLE) * 0.1
        world = BoxWorld(np.array([*street(2, 40.0).boxes, *(box(t) for box in things)]))
        poses.append(pose(np.eye(3), [speed_m_s * t, 0.0, 0.0]))
        scans.append(
            observe(world, poses[-1], index=k, stamp_ns=START_NS + k * PERIOD_NS, rng=rng, rows=rows, columns=columns)
        )  # fmt: skip
    return scans, np.array(poses)


def sensors(speed_m_s: float, said_m_s: float | None = None) -> tuple[Imu, Wheel]:
    """A gyro that does not turn and wheels that tell the speed, or another one."""
    stamp_ns = START_NS - 10 * PERIOD_NS + 10_000_000 * np.arange(10 * COUNT + 200)
    n = len(stamp_ns)
    speed = np.full(n, speed_m_s if said_m_s is None else said_m_s, np.float64)
    return Imu(stamp_ns, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1))), Wheel(
        stamp_ns, speed, np.full(n, np.nan)
    )


def dynamic(scans: list[DeskewedScan], imu: Imu, wheel: Wheel) -> list[B1]:
    labels = denoise(ONLY_MOVING, Deskewed(scans), make_session(32), imu, wheel)
    return [each.class_ == PointClass.DYNAMIC for each in labels]


def inside(scan: DeskewedScan, T: F8, box: F8, slack_m: float = 0.1) -> B1:
    """Points of a scan in a box or under it."""
    p = transform(T, scan.points())
    return ((p > box[0] - [slack_m, slack_m, 0.3]) & (p < box[1] + slack_m)).all(axis=1)


@pytest.mark.parametrize("own_m_s", [0.0, 8.0])
@pytest.mark.parametrize(
    ("size", "at", "least"),
    [
        (CAR, lambda t: (14.0 - 8.0 * t, 1.9), 0.9),  # oncoming
        (CAR, lambda t: (15.0 + 8.0 * t, 0.0), 0.7),  # ahead, as fast
        (CAR, lambda t: (10.0, 6.0 * t), 0.9),  # across
        (PERSON, lambda t: (9.0, -2.0 + 1.4 * t), 0.6),
    ],
)
def test_what_passes_is_named_and_nothing_else(
    own_m_s: float, size: tuple[float, float, float], at: Callable[[float], tuple[float, float]], least: float
) -> None:
    box = thing(size, at)
    scans, poses = drive([box], own_m_s)
    found = dynamic(scans, *sensors(own_m_s))[MIDDLE]
    true = inside(scans[MIDDLE], poses[MIDDLE], box(0.0))
    body = true & (transform(poses[MIDDLE], scans[MIDDLE].points())[:, 2] > GROUND_Z_M + 0.25)
    assert body.sum() > 10
    assert least <= found[body].mean() <= 1.0
    assert found[~true].sum() <= 0.02 * body.sum()


@pytest.mark.parametrize("own_m_s", [0.0, 8.0, 13.0])
def test_a_street_where_nothing_moves_loses_nothing(own_m_s: float) -> None:
    standing = thing(CAR, lambda t: (10.0, 2.5))
    scans, _ = drive([standing], own_m_s)
    found = dynamic(scans, *sensors(own_m_s))
    assert sum(each.sum() for each in found) < 3e-4 * sum(map(len, scans))


def test_walls_stay_where_the_wheels_lie() -> None:
    """The LiDAR stands and the wheels say it drives: all that is near seems to move, which cannot be."""
    scans, _ = drive([], 0.0)
    found = dynamic(scans, *sensors(0.0, 6.0))
    assert sum(each.sum() for each in found) < 0.01 * sum(map(len, scans))


def test_without_motion_nothing_moves() -> None:
    box = thing(CAR, lambda t: (14.0 - 8.0 * t, 1.9))
    scans, _ = drive([box], 0.0)
    apart = [
        DeskewedScan(
            x_m=s.x_m, y_m=s.y_m, z_m=s.z_m, intensity=s.intensity, scan_index=s.scan_index,
            reference_ns=START_NS + 1_000_000_000 * s.scan_index,
        )
        for s in scans
    ]  # fmt: skip
    assert not any(each.any() for each in dynamic(apart, Imu.empty(), Wheel.empty()))


def test_ground_never_moves_and_the_switch_turns_it_off() -> None:
    box = thing(CAR, lambda t: (10.0, 6.0 * t))
    scans, _ = drive([box], 0.0)
    imu, wheel = sensors(0.0)
    off = Settings(particles=False, moving=False)
    before = [*denoise(off, Deskewed(scans), make_session(32), imu, wheel)]
    after = [*denoise(ONLY_MOVING, Deskewed(scans), make_session(32), imu, wheel)]
    assert not any((each.class_ == PointClass.DYNAMIC).any() for each in before)
    changed = [a.class_ != b.class_ for a, b in zip(after, before, strict=True)]
    assert any(each.any() for each in changed)
    for a, b, different in zip(after, before, changed, strict=True):
        assert (b.class_[different] == PointClass.STATIC).all()
        assert (a.class_[different] == PointClass.DYNAMIC).all()


def test_the_same_scans_give_the_same_bytes() -> None:
    scans, _ = drive([thing(CAR, lambda t: (10.0, 6.0 * t))], 5.0)
    first, again = (dynamic(scans, *sensors(5.0)) for _ in range(2))
    assert [a.tobytes() for a in first] == [b.tobytes() for b in again]
