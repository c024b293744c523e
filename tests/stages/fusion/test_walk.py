"""The random walk of odometry, from good fixes: within bounds of what was put in, and within those of the settings."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.fusion.walk import Walk, believed, random_walk, stated
from scanloom.stages.geometry.se3 import inverse, se3_exp
from tests.stages.fusion.drives import gnss_of, odometry_of, rectangle, session_of
from tests.stages.fusion.test_agreement import EVERY, WAY, WORLD, measured
from tests.stages.fusion.test_tuning import drives_of


def wandering(seed: int, rotation_deg: float, translation_m: float) -> np.ndarray:
    """Positions by an odometry whose heading and place walk at random with the root of the way."""
    rng = np.random.default_rng(seed)
    step = inverse(WORLD.T[:-1]) @ WORLD.T[1:]
    noise = rng.normal(size=(len(step), 6)) * np.repeat([np.radians(rotation_deg), translation_m], 3)
    noise[:, :2] = 0.0
    T = [WORLD.T[0]]
    for motion in step @ se3_exp(noise * np.sqrt(np.diff(WORLD.path))[:, None]):
        T.append(T[-1] @ motion)
    at = np.array(T)[::EVERY, :3, 3]
    return at[:, 0] + 1j * at[:, 1]


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m", "noise_m"), [(0.05, 0.02, 0.02), (0.02, 0.01, 0.01), (0.1, 0.05, 0.05)]
)
def test_walks_are_told_apart(rotation_deg: float, translation_m: float, noise_m: float) -> None:
    found = [
        random_walk(
            wandering(seed, rotation_deg, translation_m), measured(np.random.default_rng(seed), noise_m), WAY
        )
        for seed in range(5)
    ]
    rotation = np.degrees([w.rotation_rad_sqrt_m for w in found if w])
    translation = [w.translation_m_sqrt_m for w in found if w]
    assert len(rotation) == 5
    assert 0.6 < np.mean(rotation) / rotation_deg < 1.1
    assert 0.7 < np.mean(translation) / translation_m < 1.5


def test_noise_of_the_fixes_is_not_taken_for_a_walk() -> None:
    found = random_walk(wandering(0, 0.01, 0.005), measured(np.random.default_rng(0), 0.5), WAY)
    assert found
    assert found.noise_m == pytest.approx(0.5, rel=0.15)
    assert found.translation_m_sqrt_m < 0.05


def test_a_third_of_wild_fixes_does_not_matter_much() -> None:
    q = measured(np.random.default_rng(0), 0.02)
    q[::12] += 20.0
    found = random_walk(wandering(0, 0.05, 0.02), q, WAY)
    assert found
    assert found.translation_m_sqrt_m < 0.1


def test_too_few_fixes_tell_nothing() -> None:
    q = measured(np.random.default_rng(0), 0.02)
    assert random_walk(q[:31], q[:31], WAY[:31]) is None
    assert random_walk(q[:0], q[:0], WAY[:0]) is None


def test_what_odometry_states_is_not_counted_twice() -> None:
    found = Walk(0.01, 0.02, 0.0)
    alone = believed((0.01, 0.02), found, 0.0, 0.0, 4.0)
    np.testing.assert_allclose(alone, (0.013, 0.026))
    beside = believed((0.01, 0.02), found, 0.012, 0.024, 4.0)
    np.testing.assert_allclose(beside, (0.005, 0.010))


def test_bounds_hold() -> None:
    assert believed((0.01, 0.02), Walk(1.0, 1.0, 0.0), 0.0, 0.0, 4.0) == (0.04, 0.08)
    assert believed((0.01, 0.02), Walk(0.0, 0.0, 0.0), 0.0, 0.0, 4.0) == (0.0025, 0.005)
    assert believed((0.01, 0.02), Walk(1.0, 0.0, 0.0), 0.0, 0.0, 1.0) == (0.01, 0.02)


def test_what_noise_hides_stays_as_set() -> None:
    """At 80 m, 0.5 m of noise hides a walk of 0.056 m per root of a metre, and of 0.085 deg."""
    set_walk = (float(np.radians(0.05)), 0.02)
    assert believed(set_walk, Walk(0.0, 0.0, 0.5), 0.0, 0.0, 4.0) == pytest.approx(set_walk)
    lower = believed(set_walk, Walk(0.0, 0.0, 0.09), 0.0, 0.0, 4.0)
    assert lower[0] == pytest.approx(0.09 * np.sqrt(4.5 / 80.0**3))
    assert lower[1] == pytest.approx(0.09 / np.sqrt(80.0))


def test_stated_walk_is_that_of_the_steps() -> None:
    world = rectangle(laps=0.5)
    drive = drives_of(session_of("a", world), gnss_of(world), odometry_of(world))[0]
    rotation, translation = stated(drive)
    assert rotation == pytest.approx(np.radians(0.01) / np.sqrt(0.8), rel=0.05)
    assert translation == pytest.approx(0.005 / np.sqrt(0.8), rel=0.05)
