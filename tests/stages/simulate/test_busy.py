"""A busy day: everybody keeps to the script, gets in nobody's way, comes and goes unseen; the truth says who is who."""

from __future__ import annotations

import io
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from scanloom.schemas.scans import PointClass, TruePoints
from scanloom.schemas.simulated import TrueTracks
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.busy import build_guests, footprint, giving_way
from scanloom.stages.simulate.estate import build_estate
from scanloom.stages.simulate.guests import Guest, clash, through
from scanloom.stages.simulate.motion import Motion, build_motion
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.stage import simulate
from scanloom.stages.simulate.town import Town, build_town
from scanloom.stages.simulate.traffic import CONVOY, build_traffic

LONG = Settings(busy=True)
SHORT = Settings(
    busy=True, beams=16, columns=64, start_m=20.0, duration_s=16.0, standstill_s=0.5, dust_per_m=0.0
)


@cache
def town() -> Town:
    return build_town(0, 0)


@cache
def cast(settings: Settings) -> tuple[Motion, list[Guest]]:
    world = build_estate(0, 0) if settings.route == "estate" else town()
    motion = build_motion(settings, world.path)
    convoy = [a for a in build_traffic(settings, world.path, motion) if a.name in CONVOY]
    return motion, build_guests(settings, world, motion, convoy)


def named(word: str, settings: Settings = LONG) -> Guest:
    return next(guest for guest in cast(settings)[1] if word in guest.name)


def speed(guest: Guest, t: F8) -> F8:
    step = guest.poses(town().path, t + 0.05)[:, :3, 3] - guest.poses(town().path, t - 0.05)[:, :3, 3]
    out: F8 = np.linalg.norm(step, axis=1) / 0.1
    return out


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrueTracks, TruePoints]:
    folder: Path = tmp_path_factory.mktemp("busy")
    _, truth = simulate(SHORT)
    truth.write(folder)
    return TrueTracks.open(folder / "tracks.parquet"), TruePoints.open(folder / "points.parquet")


def test_a_car_waits_at_the_light_in_view_and_leaves_before_it_is_passed() -> None:
    guest, motion = named("waiting at the light"), cast(LONG)[0]
    t = np.arange(0.0, 60.0, 0.1)
    stands = t[(speed(guest, t) < 0.02) & guest.present(t)]
    assert 15 < np.ptp(stands) < 30
    apart = np.linalg.norm(guest.poses(town().path, t)[:, :3, 3] - motion.poses(t)[:, :3, 3], axis=1)
    passed = t[apart.argmin()]
    assert 1 < passed - stands.max() < 6
    assert 2 < apart.min() < 5
    in_view = (t >= stands.min()) & (t <= stands.max()) & (apart < 40)
    assert in_view.sum() * 0.1 > 8
    assert speed(guest, np.array([passed + 3]))[0] > 3
    assert {guest.kind(at) for at in t} == {PointClass.DYNAMIC}


def test_a_car_comes_to_park_for_good() -> None:
    guest = named("parking")
    t = guest.stays_s
    assert speed(guest, np.array([t - 5.0]))[0] > 3
    later = guest.poses(town().path, np.array([t + 0.1, t + 20, t + 100]))
    np.testing.assert_allclose(later, later[:1].repeat(3, axis=0), atol=0.02)
    assert guest.kind(t - 0.1) == PointClass.DYNAMIC
    assert guest.kind(t) == PointClass.STATIC
    assert guest.present(np.array([t + 100]))[0]
    others = np.array([thing.centre for thing in town().things if thing.what == "car"])
    assert np.linalg.norm(others - later[0, :3, 3], axis=1).min() > 4.5


def test_people_stand_for_ten_seconds_and_walk_on() -> None:
    guest = named("standing")
    t = np.arange(guest.meets_s - 15, guest.meets_s + 13, 0.1)
    v = speed(guest, t)
    assert 9 < (v < 0.02).sum() * 0.1 < 11
    assert 0.8 < v[:20].mean() < 2.0
    assert 0.8 < v[-20:].mean() < 2.0


def test_the_cast_is_complete() -> None:
    assert {guest.what for guest in cast(LONG)[1]} >= {"car", "bus", "cyclist", "person", "dog", "pram"}
    assert 20 < len(cast(LONG)[1]) < 60


@pytest.mark.parametrize(
    "settings",
    [
        LONG,
        Settings(busy=True, seed=2, start_m=430.0, duration_s=60.0),
        Settings(busy=True, route="estate", duration_s=40.0),
    ],
)
def test_nobody_is_in_anybodys_way(settings: Settings) -> None:
    motion, guests = cast(settings)
    path = build_estate(0, 0).path if settings.route == "estate" else town().path
    assert len(guests) > 3
    marks = {guest.name: footprint(settings, path, guest) for guest in guests}
    for a, b in combinations(marks, 2):
        together = a.split(maxsplit=1)[-1] == b or b.split(maxsplit=1)[-1] == a
        assert together or not clash(marks[a], marks[b]), (a, b)
    usual = giving_way(settings, path, build_traffic(settings, path, motion), guests)
    for actor in usual:
        there = footprint(settings, path, actor)
        assert not any(clash(there, mark) for mark in marks.values()), actor.name
    assert set(CONVOY) <= {actor.name for actor in usual}


def test_guests_come_and_go_beyond_what_the_lidar_sees() -> None:
    motion, guests = cast(LONG)
    for guest in guests:
        for edge in guest.present_s:
            if 0 < edge < LONG.duration_s:
                here, there = (
                    T[0, :3, 3]
                    for T in (motion.poses(np.array([edge])), guest.poses(town().path, np.array([edge])))
                )
                assert np.linalg.norm(here - there) > LONG.max_range_m, guest.name


def test_truth_follows_each_of_them(recorded: tuple[TrueTracks, TruePoints]) -> None:
    tracks, points = recorded
    seen = list(points)
    for row in np.flatnonzero(tracks.points > 0)[::97]:
        label = seen[tracks.scan_index[row]]
        mine = label.instance == tracks.instance[row]
        assert mine.sum() == tracks.points[row]
        assert np.isin(label.class_[mine], (tracks.class_[row], PointClass.OUTLIER)).all()
    labelled = np.concatenate([label.instance[label.class_ == PointClass.DYNAMIC] for label in seen])
    assert set(labelled.tolist()) <= set(tracks.instance.tolist())


def test_a_parked_car_is_dynamic_first_and_static_then(recorded: tuple[TrueTracks, TruePoints]) -> None:
    tracks, _ = recorded
    parked = np.unique(tracks.instance[tracks.class_ == PointClass.STATIC])
    assert len(parked) >= 1
    rows = (tracks.instance == parked[0]) & (tracks.points > 0)
    classes = tracks.class_[rows]
    assert (np.diff((classes == PointClass.STATIC).astype(int)) >= 0).all()
    assert set(classes.tolist()) == {PointClass.DYNAMIC, PointClass.STATIC}
    still = tracks.speed_m_s[rows] < 0.05
    assert still[classes == PointClass.STATIC].mean() > 0.95
    assert still[classes == PointClass.DYNAMIC].mean() < 0.3


def test_nobody_of_the_cast_is_there_by_default() -> None:
    plain = SHORT.model_copy(update={"busy": False, "duration_s": 1.0})
    _, truth = simulate(plain)
    motion = build_motion(plain, town().path)
    usual = build_traffic(plain, town().path, motion)
    table = pq.read_table(io.BytesIO(truth.read("tracks.parquet")))
    assert table.num_rows == 10 * len(usual)
    assert table.column("what").to_pylist()[: len(usual)] == [actor.what for actor in usual]


def test_progress_is_monotone_and_rests_between_equal_places() -> None:
    track = through((0.0, 50.0), (8.0, 10.0), (12.0, 10.0), (20.0, -30.0))
    t = np.arange(-20.0, 40.0, 0.1)
    s = track(t)
    assert (np.diff(s) < 1e-9).all()
    np.testing.assert_allclose(track(np.array([8.0, 10.0, 12.0])), 10.0)
    assert np.diff(s)[0] / 0.1 == pytest.approx(-5.0, abs=0.1)
