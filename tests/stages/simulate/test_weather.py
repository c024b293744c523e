"""Snow, dust and spray: as dense as asked for, where and as weak as real ones, and nothing else of the log changes."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, transform
from scanloom.stages.simulate.grains import DUST_INSTANCE, SNOW_INSTANCE, SPRAY_INSTANCE, Gusts, first_met
from scanloom.stages.simulate.meshes import Material
from scanloom.stages.simulate.motion import build_motion
from scanloom.stages.simulate.plumes import LIFE_S, Burst
from scanloom.stages.simulate.rig import MIN_RANGE_M, T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.snow import Snow
from scanloom.stages.simulate.sweeping import Lidar, Sweep
from scanloom.stages.simulate.terrain import Plan
from scanloom.stages.simulate.town import Town, build_town
from scanloom.stages.simulate.traffic import build_traffic
from scanloom.stages.simulate.weather import build_weather

LIGHT, MIDDLE, HEAVY = 0.0006, 0.0035, 0.012
SHARES = {LIGHT: (0.002, 0.012), MIDDLE: (0.015, 0.05), HEAVY: (0.05, 0.15)}
DUST_SHARES = {0.2: (0.003, 0.07), 0.5: (0.03, 0.2), 1.5: (0.1, 0.45)}


@cache
def town() -> Town:
    return build_town(0, 0)


@cache
def drive(
    start_m: float = 20.0, duration_s: float = 2.0, seed: int = 0, columns: int = 256, **air: float
) -> list[Sweep]:
    """Sweeps of a coarse LiDAR without the truck's dust."""
    settings = _settings(start_m=start_m, duration_s=duration_s, seed=seed, columns=columns, **air)
    path = town().path
    motion = build_motion(settings, path)
    movers = build_traffic(settings, path, motion)
    return list(
        Lidar(settings, town(), motion, movers, build_weather(settings, path, motion, movers)).sweeps()
    )


def _settings(**given: Any) -> Settings:
    return Settings(beams=16, standstill_s=0.5, dust_per_m=0.0, **given)


def airborne(sweeps: list[Sweep]) -> tuple[F8, F8, float]:
    """Ranges and intensities of what is in the air, and its share."""
    kind = np.concatenate([sweep.kind for sweep in sweeps])
    range_m = np.linalg.norm(np.concatenate([sweep.xyz for sweep in sweeps]).astype(float), axis=1)
    intensity = np.concatenate([sweep.intensity for sweep in sweeps]).astype(float)
    rows = kind == PointClass.AIRBORNE
    return range_m[rows], intensity[rows], float(rows.mean())


@pytest.mark.parametrize("per_m", SHARES)
def test_snow_is_as_dense_as_asked_for(per_m: float) -> None:
    low, high = SHARES[per_m]
    shares = [airborne(drive(seed=seed, snow_per_m=per_m))[2] for seed in (0, 1)]
    assert low < np.mean(shares) < high
    assert max(shares) < 3 * min(shares)


def test_snow_is_near_and_weak_with_a_tail() -> None:
    sweeps = drive(snow_per_m=HEAVY)
    range_m, intensity, _ = airborne(sweeps)
    assert range_m.min() >= MIN_RANGE_M
    assert 4 < np.median(range_m) < 12
    assert 12 < np.percentile(range_m, 95) < 28
    ground = np.concatenate([sweep.intensity[sweep.kind == PointClass.GROUND] for sweep in sweeps])
    assert 0.1 < np.median(intensity) < 0.6 * np.median(ground)
    # A threshold on the intensity alone loses road or keeps snow.
    assert 0.03 < (intensity > np.median(ground)).mean() < 0.3
    assert np.percentile(intensity, 99) > 10


def test_no_snow_falls_in_the_tunnel() -> None:
    low, high = Plan().tunnel
    snow = Snow.of(0, HEAVY, 16, Plan().tunnel)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((16 * 512, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = np.full(len(direction), 4.0, np.float32)
    counts = []
    for x in (low - 8.0, (low + high) / 2, high + 8.0):
        origin = np.tile([x, 0.0, 2.0], (len(direction), 1))
        counts.append(len(snow.met(0, 1.0, origin, direction, reach).rows))
    assert counts[1] == 0
    assert min(counts[0], counts[2]) > 20


def test_flakes_are_others_in_every_sweep_and_dust_stays() -> None:
    """From one sweep to the next, while the vehicle stands and soon after."""
    near = [_again(drive(snow_per_m=HEAVY)), _again(drive(20.0, 4.0, 1, 512, dust_clouds=1.5))]
    assert near[0] < 0.25
    assert 0.45 < near[1] < 0.95


def _again(sweeps: list[Sweep]) -> float:
    """Share of what is in the air of a sweep that has something of the air of the sweep before within 0.4 m."""
    found = []
    for before, now in pairwise(sweeps):
        old, new = (s.xyz[s.kind == PointClass.AIRBORNE] for s in (before, now))
        if len(old) > 20 and len(new) > 20:
            found.append(cKDTree(old).query(new)[0] < 0.4)
    return float(np.concatenate(found).mean())


@pytest.mark.parametrize("extinction", DUST_SHARES)
def test_dust_is_as_dense_as_asked_for(extinction: float) -> None:
    low, high = DUST_SHARES[extinction]
    places = ((20.0, 2), (620.0, 1))
    shares = [airborne(drive(start, 5.0, seed, 128, dust_clouds=extinction))[2] for start, seed in places]
    assert low < np.mean(shares) < high


def test_dense_dust_is_metres_wide_and_has_a_surface() -> None:
    """The ray beside one that dense dust sends back mostly ends beside it; with snow only where flakes stick together."""
    dust, snow = drive(20.0, 4.0, 1, 512, dust_clouds=1.5), drive(snow_per_m=MIDDLE)
    assert 0.35 < _ranks(dust, 512) < 0.8
    assert 0.03 < _ranks(snow, 256) < 0.15
    widths = [
        np.ptp(np.percentile(points, [10, 90], axis=0)[:, :2], axis=0).max()
        for points in (sweep.xyz[sweep.kind == PointClass.AIRBORNE] for sweep in dust)
        if len(points) > 20
    ]
    assert 3 < np.median(widths) < 40


def _ranks(sweeps: list[Sweep], columns: int) -> float:
    """Share of what is in the air that has something of the air, within 0.5 m in range, on a ray beside."""
    near: list[NDArray[np.bool_]] = []
    for sweep in sweeps:
        rows = sweep.kind == PointClass.AIRBORNE
        image = np.full((16, columns), np.nan)
        column = np.round(sweep.time_s[rows] * 10 * columns).astype(int) % columns
        image[sweep.ring[rows], column] = np.linalg.norm(sweep.xyz[rows], axis=1)
        steps = np.stack([np.abs(image - np.roll(image, shift, 1)) for shift in (1, -1)])
        near.append((np.nan_to_num(steps, nan=np.inf).min(axis=0) < 0.5)[np.isfinite(image)])
    return float(np.concatenate(near).mean())


def test_a_burst_drifts_spreads_thins_and_ends() -> None:
    burst = Burst(np.array([1.0]), np.zeros((1, 3)), np.array([2.0]), np.array([3.0, 0.0, 0.0]))
    assert burst.puffs(1.0) == []
    assert burst.puffs(1.0 + LIFE_S) == []
    early, late = burst.puffs(2.0)[0], burst.puffs(5.0)[0]
    assert late.centre[0] - early.centre[0] == pytest.approx(9.0)
    assert (late.sigma_m > early.sigma_m).all()
    assert 0 < late.extinction < early.extinction < 2.0


@pytest.mark.parametrize("air", [{"snow_per_m": HEAVY}, {"dust_clouds": 1.5}, {"spray_per_m": 3.0}])
def test_grains_hide_what_is_behind_and_change_nothing_else(air: dict[str, float]) -> None:
    clean, dirty = drive(430.0, 4.0), drive(430.0, 4.0, **air)
    hidden = 0
    for before, after in zip(clean, dirty, strict=True):
        known = dict(zip(_rays(before), _rows(before), strict=True))
        for ray, row, kind in zip(_rays(after), _rows(after), after.kind.tolist(), strict=True):
            if kind not in (PointClass.AIRBORNE, PointClass.OUTLIER):
                assert known[ray] == row
            elif kind == PointClass.AIRBORNE and ray in known and known[ray][4] != PointClass.OUTLIER:
                hidden += 1
                # As much as the noise of two ranges, the beam's zero included in both.
                assert np.linalg.norm(row[:3]) < np.linalg.norm(known[ray][:3]) + 0.01
    assert hidden > 30


def _rays(sweep: Sweep) -> list[tuple[int, float]]:
    return list(zip(sweep.ring.tolist(), sweep.time_s.tolist(), strict=True))


def _rows(sweep: Sweep) -> list[tuple[float, ...]]:
    columns = (*sweep.xyz.T, sweep.intensity, sweep.kind, sweep.instance, sweep.material)
    return list(zip(*(column.tolist() for column in columns), strict=True))


def test_spray_is_low_and_behind_wheels() -> None:
    sweeps = drive(430.0, 4.0, spray_per_m=3.0)
    points = np.concatenate([transform(T_BASE["lidar"], s.xyz[s.instance == SPRAY_INSTANCE]) for s in sweeps])
    own = (np.abs(points[:, 1]) < 3) & (points[:, 0] < 0) & (points[:, 0] > -12)
    assert own.sum() > 100
    assert 0.0 < np.percentile(points[own, 2], 90) < 1.8
    assert not any((sweep.instance == SPRAY_INSTANCE).any() for sweep in drive(430.0, 4.0))


def test_truth_tells_what_floats_and_what_grows() -> None:
    sweeps = [
        *drive(snow_per_m=HEAVY),
        *drive(20.0, 4.0, 1, 512, dust_clouds=1.5),
        *drive(430.0, 4.0, spray_per_m=3.0),
    ]
    material, kind, instance = (
        np.concatenate([getattr(sweep, name) for sweep in sweeps])
        for name in ("material", "kind", "instance")
    )
    pairs = (
        (Material.SNOW, SNOW_INSTANCE),
        (Material.DUST, DUST_INSTANCE),
        (Material.WATER, SPRAY_INSTANCE),
    )
    for made_of, number in pairs:
        rows = material == made_of
        assert rows.sum() > 100
        assert (instance[rows] == number).all()
        assert (kind[rows] != PointClass.STATIC).all()
    leaves = material == Material.LEAF
    assert leaves.sum() > 100
    assert np.isin(kind[leaves], (PointClass.STATIC, PointClass.OUTLIER)).all()


def test_the_default_has_clean_air() -> None:
    settings = Settings()
    path = town().path
    motion = build_motion(settings, path)
    assert build_weather(settings, path, motion, build_traffic(settings, path, motion)) == []


@pytest.mark.parametrize(("needed", "spread"), [(1, 1.0), (4, 0.5)])
def test_free_path_in_even_air(needed: int, spread: float) -> None:
    """Extinction 0.5 per metre: mean 2 m; the spread of a sum of `needed` exponentials."""
    rng = np.random.default_rng(0)
    rows: NDArray[np.int64] = np.arange(20_000)
    reach = np.full(len(rows), np.inf, np.float32)
    reach[:5] = 0.0
    met, range_m = first_met(
        rng,
        rows,
        reach,
        lambda depth, _: depth / (needed * 0.5 * 2),
        lambda r, _: np.full(len(r), 0.5),
        needed,
    )
    assert len(met) == len(rows) - 5
    assert range_m.mean() == pytest.approx(2.0, rel=0.03)
    assert range_m.std() == pytest.approx(2.0 * spread, rel=0.05)


def test_gusts_are_one_on_average_bounded_and_move() -> None:
    rng = np.random.default_rng(3)
    gusts = Gusts.of(rng, np.array([2.0, 0.0, 0.0]), (3.0, 15.0), 0.6)
    p = rng.uniform(-200, 200, (20_000, 3))
    density = gusts(p, 0.0)
    assert density.mean() == pytest.approx(1.0, abs=0.1)
    assert 0.3 < density.std() < 1.0
    assert density.max() <= Gusts.MOST
    np.testing.assert_allclose(gusts(p + np.array([2.0, 0, 0]), 1.0), density, rtol=1e-9)
