"""Clock and antenna of the GNSS receiver from the motion: found where it tells them, left alone where it does not."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.fusion import lever_arm
from scanloom.stages.fusion.drives import Drive, gather
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.fusion.gravity import gravity
from scanloom.stages.fusion.tuning import tuned
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import pose
from tests.stages.fusion.drives import (
    ANTENNA,
    START_NS,
    World,
    gnss_at,
    gnss_of,
    odometry_of,
    parts,
    rectangle,
    session_of,
)


def driven(speed_m_s: np.ndarray, world: World | None = None) -> World:
    """The way of a world driven at other speeds, one scan per 0.1 s."""
    way = world or rectangle(laps=4.0, speed=1.0)
    s = np.cumsum(speed_m_s) * 0.1
    s = s[s < way.path[-1]]
    T = interpolate_poses((way.path * 1e6).astype(np.int64), way.T, (s * 1e6).astype(np.int64))
    return World(T, START_NS + np.arange(len(s)) * 100_000_000)


WORLD = driven(8.0 + 4.0 * np.sin(np.arange(4000) * 0.1 / 6.0))
ODOMETRY = odometry_of(WORLD)


def silent(session: Session) -> Session:
    """A session that does not say where the antenna is."""
    return session.model_copy(
        update={"extrinsics": tuple(e for e in session.extrinsics if e.sensor != "gnss")}
    )


def drives_of(
    session: Session, gnss: Gnss, odometry: Odometry = ODOMETRY, late_s: float = 0.0
) -> list[Drive]:
    late = dataclasses.replace(gnss, stamp_ns=gnss.stamp_ns + round(late_s * 1e9))
    return list(gather(parts(a=session), parts(a=odometry), parts(a=late), parts(a=Imu.empty())))


def tune(
    session: Session, gnss: Gnss, late_s: float = 0.0, most_s: float = 20.0, odometry: Odometry = ODOMETRY
) -> tuple[float, np.ndarray, list[str]]:
    """Seconds taken off the stamps, antenna in the LiDAR frame, remarks."""
    drives = drives_of(session, gnss, odometry, late_s)
    ups = [gravity(d, 10.0) for d in drives]
    found, remarks = tuned(GnssSettings(max_clock_offset_s=most_s), drives, ups)
    shift = (drives[0].gnss.stamp_ns - found[0].gnss.stamp_ns) * 1e-9
    assert np.ptp(shift) < 1e-9
    return float(shift[0]), found[0].antenna_m, remarks


@pytest.mark.parametrize("late_s", [-3.3, -0.25, 0.6, 18.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_clock_is_found_and_corrected(late_s: float, seed: int) -> None:
    gnss = gnss_of(WORLD, sigma=0.1, seed=seed, every=5)
    offset, antenna, remarks = tune(session_of("a", WORLD), gnss, late_s)
    assert 1e-5 < abs(offset - late_s) < 0.02
    np.testing.assert_allclose(antenna, ANTENNA, atol=1e-12)
    assert len(remarks) == 1
    assert f"{abs(late_s):.1f}"[:2] in remarks[0]
    assert ("late" if late_s > 0 else "early") in remarks[0]


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_that_is_right_is_left_alone(seed: int) -> None:
    offset, _, remarks = tune(session_of("a", WORLD), gnss_of(WORLD, sigma=0.1, seed=seed, every=5))
    assert offset == 0.0
    assert remarks == []


@pytest.mark.parametrize("arm", [(-1.4, 0.5, 0.0), (2.0, 0.0, 0.0), (0.0, -0.8, 0.0)])
@pytest.mark.parametrize("late_s", [0.0, 0.8])
def test_antenna_is_found_with_and_without_the_clock(arm: tuple[float, ...], late_s: float) -> None:
    """Silent logs have it at the base, which lies half a metre behind the LiDAR and 1.7 m below."""
    gnss = gnss_of(WORLD, sigma=0.1, every=5, antenna=np.array(arm))
    offset, antenna, remarks = tune(silent(session_of("a", WORLD)), gnss, late_s)
    assert 1e-4 < np.abs(antenna - arm)[:2].max() < 0.2
    assert abs(offset - late_s) < 0.03
    assert any("antenna found" in r for r in remarks)
    assert antenna[2] == pytest.approx(-1.7)


def test_directions_of_the_antenna_are_said_in_words() -> None:
    gnss = gnss_of(WORLD, sigma=0.05, every=5, antenna=np.array([-2.0, 1.0, 0.0]))
    *_, remarks = tune(silent(session_of("a", WORLD)), gnss)
    assert re.search(r"1\.[45]\d m behind and (1\.0|0\.9)\d m left of", remarks[0])


def test_an_antenna_that_the_log_gives_is_not_touched() -> None:
    _, antenna, remarks = tune(
        session_of("a", WORLD), gnss_of(WORLD, antenna=ANTENNA + np.array([0.6, 0.4, 0.0]))
    )
    np.testing.assert_allclose(antenna, ANTENNA, atol=1e-12)
    assert not any("antenna" in r for r in remarks)


def test_one_speed_along_a_line_tells_neither() -> None:
    n = 900
    line = World(
        pose(np.tile(np.eye(3), (n, 1, 1)), np.column_stack((np.arange(n) * 0.8, np.zeros(n), np.zeros(n)))),
        START_NS + np.arange(n) * 100_000_000,
    )
    gnss = gnss_of(line, sigma=0.1, every=5, antenna=np.array([-1.0, 0.5, 0.0]))
    offset, antenna, remarks = tune(
        silent(session_of("a", line)),
        gnss,
        late_s=0.5,
        odometry=odometry_of(line, yaw_drift_deg_per_100m=0.2),
    )
    assert offset == 0.0
    np.testing.assert_allclose(antenna, [-0.5, 0.0, -1.7])
    assert any(lever_arm.UNKNOWN in r for r in remarks)


def test_clock_and_antenna_survive_lies() -> None:
    gnss = gnss_of(WORLD, sigma=0.1, every=5, antenna=np.array([-1.4, 0.5, 0.0]))
    rng = np.random.default_rng(3)
    wrong = rng.random(len(gnss)) < 0.2
    latitude = (
        gnss.latitude_deg + wrong * rng.choice([-1, 1], len(gnss)) * rng.uniform(5, 30, len(gnss)) / 111e3
    )
    offset, antenna, _ = tune(
        silent(session_of("a", WORLD)), dataclasses.replace(gnss, latitude_deg=latitude), late_s=0.8
    )
    assert abs(offset - 0.8) < 0.03
    assert np.abs(antenna - [-1.4, 0.5, 0.0])[:2].max() < 0.2


def test_no_offset_is_looked_for_beyond_the_bound() -> None:
    gnss, session = gnss_of(WORLD, sigma=0.1, every=5), session_of("a", WORLD)
    inside, *_ = tune(session, gnss, late_s=1.9, most_s=2.0)
    assert inside == pytest.approx(1.9, abs=0.02)
    beyond, *_ = tune(session, gnss, late_s=6.0, most_s=2.0)
    assert abs(beyond) <= 2.0
    switched_off, *_ = tune(session, gnss, late_s=0.6, most_s=0.0)
    assert switched_off == 0.0


def wandering_gnss(seed: int, antenna: tuple[float, ...], sigma: float = 0.5, tau_s: float = 5.0) -> Gnss:
    """Fixes once a second whose error lasts for seconds, as a receiver's does."""
    rng, every = np.random.default_rng(seed), 10
    T = WORLD.T[::every]
    error, keep = rng.normal(0.0, sigma, (len(T), 3)), np.exp(-1.0 / tau_s)
    for k in range(1, len(T)):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * error[k]
    return gnss_at(WORLD.stamp_ns[::every], T[:, :3, :3] @ np.array(antenna) + T[:, :3, 3] + error, sigma)


def test_errors_that_last_are_not_taken_for_a_clock_or_an_antenna() -> None:
    """It is at the base, where a silent log is taken to have it; hardly ever moved, and by less than fixes are off."""
    session, moved = silent(session_of("a", WORLD)), []
    for seed in range(8):
        offset, antenna, _ = tune(session, wandering_gnss(seed, (-0.5, 0.0, -1.7)))
        assert offset == 0.0
        moved.append(float(np.linalg.norm(antenna - [-0.5, 0.0, -1.7])))
    assert np.count_nonzero(np.array(moved) > 1e-9) <= 2
    assert max(moved) < 0.5


@pytest.mark.parametrize("seed", range(3))
def test_nor_do_they_hide_a_clock_that_is_far_off(seed: int) -> None:
    offset, *_ = tune(session_of("a", WORLD), wandering_gnss(seed, tuple(ANTENNA)), late_s=0.5)
    assert offset == pytest.approx(0.5, abs=0.1)


def test_few_fixes_tell_nothing() -> None:
    offset, antenna, remarks = tune(session_of("a", WORLD), gnss_of(WORLD, every=200))
    assert (offset, remarks) == (0.0, [])
    np.testing.assert_allclose(antenna, ANTENNA, atol=1e-12)


def test_a_stretched_position_is_remarked() -> None:
    """A receiver in a map projection, or a LiDAR that measures long."""
    stretched = World(WORLD.T.copy(), WORLD.stamp_ns)
    stretched.T[:, :3, 3] *= 1.01
    *_, remarks = tune(session_of("a", WORLD), gnss_of(stretched, sigma=0.05, every=5))
    assert any(re.search(r"1\.[01] % longer", r) for r in remarks)
