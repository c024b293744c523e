"""Lies among fixes are named, honest ones are kept: with noise, drift, bursts and pauses."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.stages.fusion.agreement import agreeing, longest_chain, straightened
from tests.stages.fusion.drives import odometry_of, rectangle
from tests.stages.fusion.test_tuning import driven

WORLD = driven(8.0 + 3.0 * np.sin(np.arange(2400) * 0.1 / 6.0), rectangle(laps=12.0, speed=1.0))
EVERY = 10
TRUE = WORLD.T[::EVERY, 0, 3] + 1j * WORLD.T[::EVERY, 1, 3]
WAY = WORLD.path[::EVERY]
N = len(TRUE)
TOLERANCE_M, DRIFT, FARTHEST_M = 0.3, 0.02, 400.0


def by_odometry(seed: int, yaw_drift_deg_per_100m: float) -> np.ndarray:
    track = odometry_of(WORLD, seed=seed, yaw_drift_deg_per_100m=yaw_drift_deg_per_100m)
    return track.T_odom_lidar[::EVERY, 0, 3] + 1j * track.T_odom_lidar[::EVERY, 1, 3]


def measured(rng: np.random.Generator, sigma: float) -> np.ndarray:
    return TRUE + sigma * (rng.normal(size=N) + 1j * rng.normal(size=N))


def kept(p: np.ndarray, q: np.ndarray, sigma: float) -> np.ndarray:
    return agreeing(p, q, WAY, DRIFT * WAY, np.full(len(q), sigma), TOLERANCE_M, FARTHEST_M)


def precision_recall(keep: np.ndarray, lying: np.ndarray) -> tuple[float, float]:
    named = ~keep
    return float((named & lying).sum() / named.sum()), float((named & lying).sum() / lying.sum())


@pytest.mark.parametrize("sigma", [0.03, 0.3, 1.0])
@pytest.mark.parametrize("drift", [0.2, 2.0])
def test_honest_fixes_are_kept(sigma: float, drift: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        keep = kept(by_odometry(seed, drift), measured(rng, sigma), sigma)
        assert keep.mean() > 0.98


@pytest.mark.parametrize(("sigma", "least_m"), [(0.1, 5.0), (0.5, 5.0), (1.0, 10.0)])
def test_single_lies_are_named(sigma: float, least_m: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        lying = rng.random(N) < 0.2
        shift = rng.uniform(least_m, 30.0, N) * np.exp(2j * np.pi * rng.random(N))
        keep = kept(by_odometry(seed, 1.0), measured(rng, sigma) + lying * shift, sigma)
        precision, recall = precision_recall(keep, lying)
        assert precision >= 0.95
        assert recall >= 0.95


def test_bursts_are_named_as_a_whole() -> None:
    """Twenty seconds moved together by 12 m (one sigma); at least by 3 m here, ten times the noise."""
    scores = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        lying, q = np.zeros(N, bool), measured(rng, 0.3)
        for start in (20, 75, 130, 185):
            shift = 12.0 * (rng.normal() + 1j * rng.normal())
            lying[start : start + 20] = True
            q[start : start + 20] += shift * max(1.0, 3.0 / abs(shift))
        scores.append(precision_recall(kept(by_odometry(seed, 1.0), q, 0.3), lying))
    precision, recall = np.mean(scores, axis=0)
    assert precision >= 0.95
    assert recall >= 0.95


def test_a_shift_within_the_noise_is_not_named() -> None:
    """What is smaller than tolerance and noise together cannot be told from them, and must not be."""
    rng = np.random.default_rng(0)
    q = measured(rng, 0.5)
    q[60:80] += 0.4
    assert kept(by_odometry(0, 1.0), q, 0.5)[60:80].mean() > 0.9


def test_a_pause_does_not_cut_the_chain() -> None:
    """Odometry drifts by metres while there is no fix for 700 m: what comes after is as good as what came before."""
    there = (WAY < 300.0) | (WAY > 1000.0)
    rng = np.random.default_rng(1)
    q, p = measured(rng, 0.1), by_odometry(1, 2.0)
    keep = agreeing(
        p[there], q[there], WAY[there], DRIFT * WAY[there], np.full(there.sum(), 0.1), TOLERANCE_M, FARTHEST_M
    )
    assert keep.mean() > 0.97


def test_a_mirrored_or_stretched_track_is_not_followed() -> None:
    rng = np.random.default_rng(2)
    p, q = by_odometry(2, 1.0), measured(rng, 0.2)
    assert kept(p, q, 0.2).mean() > 0.98
    assert kept(p, np.conj(q), 0.2).mean() < 0.5
    assert kept(p, 1.5 * q.real + 1j * q.imag, 0.2).mean() < 0.5


def test_chain_at_its_tolerance() -> None:
    way = np.arange(10) * 5.0
    allowed = 0.3 + 3.5 * np.hypot(0.1, 0.1) + 0.02 * 5.0
    step = np.zeros(10)
    step[4] = 1.0
    at, beyond = (step * factor * allowed + 0j for factor in (0.999, 1.001))
    sigma = np.full(10, 0.1)
    assert longest_chain(at, way, 0.02 * way, sigma, 0.3, 400.0).all()
    np.testing.assert_array_equal(
        longest_chain(beyond, way, 0.02 * way, sigma, 0.3, 400.0), np.arange(10) != 4
    )


def test_few_or_standing_fixes() -> None:
    still = np.full(20, 3.0 + 4.0j)
    assert straightened(still, still, np.zeros(20), np.zeros(20), np.ones(20), 0.3, np.ones(20, bool)) is None
    assert agreeing(still[:2], still[:2], np.zeros(2), np.zeros(2), np.ones(2), 0.3, 400.0).all()
    assert len(longest_chain(still[:0], np.zeros(0), np.zeros(0), np.zeros(0), 0.3, 400.0)) == 0


def test_where_scans_saw_nothing_gnss_is_not_doubted() -> None:
    """Odometry loses 12 m over a stretch of 60 m: with slack there all fixes stay, without it one side is lost."""
    rng = np.random.default_rng(5)
    p, q = by_odometry(5, 0.5), measured(rng, 0.1)
    inside = (WAY > 500.0) & (WAY < 560.0)
    lost = np.cumsum(inside) / inside.sum()
    heading = np.diff(p, prepend=p[0])[inside].mean()
    slipped = p - 12.0 * lost * heading / np.abs(heading)
    slack = DRIFT * WAY + 60.0 * lost
    sigma = np.full(N, 0.1)
    assert agreeing(slipped, q, WAY, slack, sigma, TOLERANCE_M, FARTHEST_M).mean() > 0.97
    assert agreeing(slipped, q, WAY, DRIFT * WAY, sigma, TOLERANCE_M, FARTHEST_M)[WAY < 1000.0].mean() < 0.97
