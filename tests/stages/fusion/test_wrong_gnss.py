"""Logs whose GNSS is wrong as a whole or in large parts: a local frame and a reason in words, never a bent map."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.gnss import unseen_way_m
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import inverse
from tests.stages.fusion.drives import START_NS, World, ate, gnss_of, odometry_of, rectangle, session_of
from tests.stages.fusion.test_fusion import fuse, in_truth_frame
from tests.stages.fusion.test_tuning import driven, drives_of

WORLD = driven(np.full(2000, 8.0), rectangle(laps=2.0, a=120.0, b=70.0, speed=1.0))
ODOMETRY = odometry_of(WORLD, yaw_drift_deg_per_100m=0.5)
GNSS = gnss_of(WORLD, sigma=0.2)
N = len(GNSS)
SPREAD = np.random.default_rng(4).normal(0.0, 40.0 / 111e3, (2, N))


def changed(
    latitude: np.ndarray | None = None, longitude: np.ndarray | None = None, **columns: object
) -> Gnss:
    place = {
        "latitude_deg": GNSS.latitude_deg if latitude is None else latitude,
        "longitude_deg": GNSS.longitude_deg if longitude is None else longitude,
    }
    return dataclasses.replace(GNSS, **{**place, **columns})


def in_japan() -> Gnss:
    """Swapped there, the latitude is 139 degrees."""
    geodetic = world_to_geodetic(georeference(35.7, 139.7, 40.0), _east_north_up())
    return dataclasses.replace(GNSS, latitude_deg=geodetic[:, 1].copy(), longitude_deg=geodetic[:, 0].copy())


def _east_north_up() -> np.ndarray:
    return WORLD.T[::2][:, :3, 3]


WRONG: dict[str, tuple[Callable[[], Gnss], str]] = {
    "southern hemisphere": (lambda: changed(-GNSS.latitude_deg), "mirrored"),
    "western hemisphere": (lambda: changed(longitude=-GNSS.longitude_deg), "mirrored"),
    "swapped": (lambda: changed(GNSS.longitude_deg, GNSS.latitude_deg), "swapped"),
    "swapped beyond the pole": (in_japan, "no position on the Earth"),
    "zero": (lambda: changed(np.zeros(N), np.zeros(N)), "position is zero"),
    "constant": (
        lambda: changed(np.full(N, 49.0), np.full(N, 8.4)),
        "stands still while the vehicle drives|contradict",
    ),
    "constant but for noise": (
        lambda: changed(49.0 + SPREAD[0] / 20.0, 8.4 + SPREAD[1] / 20.0),
        "contradict the motion",
    ),
    "jumps with every fix": (
        lambda: changed(GNSS.latitude_deg + SPREAD[0], GNSS.longitude_deg + SPREAD[1]),
        "contradict the motion",
    ),
    "not a number": (lambda: changed(np.full(N, np.nan)), "receiver reports no fix"),
    "infinite": (lambda: changed(longitude=np.full(N, np.inf)), "receiver reports no fix"),
    "no height": (lambda: changed(height_m=np.full(N, np.nan)), "receiver reports no fix"),
    "south pole": (lambda: changed(GNSS.latitude_deg - 137.0), "beyond the reach of UTM"),
    "another day": (
        lambda: changed(stamp_ns=GNSS.stamp_ns + 86_400 * 10**9),
        "outside the time of the scans",
    ),
    "another drive": (lambda: _another_drive(), "contradict the motion"),
}


def _another_drive() -> Gnss:
    """Good fixes of a vehicle that took other turns."""
    n = N
    yaw = np.cumsum(0.05 * np.sin(np.arange(n) / 9.0))
    step = 1.6 * np.column_stack((np.cos(yaw), np.sin(yaw), np.zeros(n)))
    geodetic = world_to_geodetic(georeference(49.0, 8.4, 100.0), np.cumsum(step, axis=0))
    return changed(geodetic[:, 0].copy(), geodetic[:, 1].copy())


@pytest.mark.parametrize("name", WRONG)
def test_gnss_that_is_all_wrong_gives_a_local_frame(name: str) -> None:
    make, reason = WRONG[name]
    poses, graph = fuse(make(), odometry=ODOMETRY, world=WORLD)
    alone = ate(ODOMETRY.T_odom_lidar, WORLD.T)
    assert poses.frame == "map"
    assert poses.georeference is None
    assert ate(poses.T_world_lidar, WORLD.T) < alone + 0.1, "no worse than odometry alone"
    verdicts = set(graph.verdict[graph.kind == "gnss"])
    assert "used" not in verdicts
    assert any(word in verdict for verdict in verdicts for word in reason.split("|")), verdicts
    assert any("GNSS" in w and "local frame" in w for w in graph.warnings), graph.warnings


PARTS: dict[str, Callable[[np.ndarray], Gnss]] = {
    "frozen": lambda rows: changed(
        np.where(rows, GNSS.latitude_deg[np.argmax(rows)], GNSS.latitude_deg),
        np.where(rows, GNSS.longitude_deg[np.argmax(rows)], GNSS.longitude_deg),
    ),
    "zero": lambda rows: changed(
        np.where(rows, 0.0, GNSS.latitude_deg), np.where(rows, 0.0, GNSS.longitude_deg)
    ),
    "not a number": lambda rows: changed(np.where(rows, np.nan, GNSS.latitude_deg)),
    "moved together": lambda rows: changed(GNSS.latitude_deg + rows * 30.0 / 111e3),
    "jumping": lambda rows: changed(
        GNSS.latitude_deg + rows * SPREAD[0], GNSS.longitude_deg + rows * SPREAD[1]
    ),
    "other hemisphere": lambda rows: changed(np.where(rows, -GNSS.latitude_deg, GNSS.latitude_deg)),
}


@pytest.mark.parametrize("part", [(0.0, 0.4), (0.3, 0.7), (0.55, 1.0)])
@pytest.mark.parametrize("name", PARTS)
def test_part_of_the_log_is_wrong_and_the_rest_is_used(name: str, part: tuple[float, float]) -> None:
    rows = (np.arange(N) >= part[0] * N) & (np.arange(N) < part[1] * N)
    poses, graph = fuse(PARTS[name](rows), odometry=ODOMETRY, world=WORLD)
    used = graph.verdict[graph.kind == "gnss"] == "used"
    assert poses.frame == "world"
    assert used[rows].sum() <= 0.02 * rows.sum(), (
        "by chance some of those that jump are near where they should be"
    )
    assert used[~rows].sum() > 40
    assert 0.01 < ate(in_truth_frame(poses), WORLD.T, align=False) < 2.0, "what odometry drifts without fixes"


def test_the_share_of_contradicting_fixes_is_said() -> None:
    rows = (np.arange(N) >= 0.3 * N) & (np.arange(N) < 0.5 * N)
    _, graph = fuse(PARTS["moved together"](rows), odometry=ODOMETRY, world=WORLD)
    assert any(f"{rows.sum()} of {N} GNSS fixes (20 %) contradict" in r for r in graph.remarks), graph.remarks
    _, graph = fuse(GNSS, odometry=ODOMETRY, world=WORLD)
    assert graph.remarks == []


def test_a_session_across_the_date_line_is_no_worse() -> None:
    for longitude in (180.0, -180.0):
        origin = georeference(-17.0, longitude, 20.0)
        geodetic = world_to_geodetic(origin, _east_north_up() - _east_north_up().mean(axis=0))
        gnss = changed(geodetic[:, 0].copy(), geodetic[:, 1].copy())
        assert gnss.longitude_deg.min() < -179.9
        assert gnss.longitude_deg.max() > 179.9
        poses, graph = fuse(gnss, odometry=ODOMETRY, world=WORLD)
        assert poses.frame == "world"
        assert (graph.verdict[graph.kind == "gnss"] == "used").sum() > 40
        assert 0.01 < ate(poses.T_world_lidar, WORLD.T) < 1.5, "the antenna is told to be elsewhere"


def test_a_height_that_jumps_is_named() -> None:
    height = GNSS.height_m.copy()
    height[200:204] += 8.0
    _, graph = fuse(changed(height_m=height), odometry=ODOMETRY, world=WORLD)
    verdict = graph.verdict[graph.kind == "gnss"]
    assert set(verdict[200:204]) == {"height jumps against odometry's"}
    assert not any("height" in v for v in np.delete(verdict, np.arange(200, 204)))


def test_a_vehicle_that_stands_is_no_frozen_receiver() -> None:
    """Standing for ten seconds with the same position: all of them are honest, most of them are not needed."""
    stop = np.full(1200, 8.0)
    stop[400:500] = 0.0
    world = driven(stop, rectangle(laps=3.0, speed=1.0))
    track, gnss = odometry_of(world), gnss_of(world, sigma=0.1)
    still = np.flatnonzero(np.diff(world.path[::2], prepend=-1.0) < 1e-9)
    held = {k: getattr(gnss, k).copy() for k in ("latitude_deg", "longitude_deg", "height_m")}
    for values in held.values():
        values[still] = values[still[0]]
    poses, graph = fuse(dataclasses.replace(gnss, **held), odometry=track, world=world)
    verdict = graph.verdict[graph.kind == "gnss"]
    assert len(still) > 40
    assert not any("stands still" in v for v in verdict)
    assert poses.frame == "world"


def test_where_scans_saw_nothing_gnss_decides() -> None:
    """Odometry loses 12 m of 24 along a wall-less stretch: said to be unseen, no fix is blamed; unsaid, some are."""
    rows = slice(400, 430)
    T, p = ODOMETRY.T_odom_lidar.copy(), ODOMETRY.direction_p.copy()
    step = inverse(T[:-1]) @ T[1:]
    step[rows, :3, 3] *= 0.5
    for k in range(rows.start, len(T) - 1):
        T[k + 1] = T[k] @ step[k]
    p[rows.start + 1 : rows.stop + 1, 0] = 0.0
    slipped = dataclasses.replace(ODOMETRY, T_odom_lidar=T)
    blamed = []
    for track in (slipped, dataclasses.replace(slipped, direction_p=p)):
        _, graph = fuse(GNSS, odometry=track, world=WORLD)
        blamed.append(sum("disagrees" in v for v in graph.verdict[graph.kind == "gnss"]))
    assert blamed[0] > 3
    assert blamed[1] == 0
    drive = drives_of(session_of("a", WORLD), GNSS, dataclasses.replace(slipped, direction_p=p))[0]
    lost = unseen_way_m(drive)
    assert lost[0] == 0.0
    assert lost[-1] == pytest.approx(30 * 0.8, rel=0.05), "at the usual speed, not at odometry's"


def test_a_straight_drive_with_a_wrong_sign_cannot_be_told() -> None:
    """A limit, stated: without a turn a mirrored track is a track."""
    n = 600
    line = World(np.tile(np.eye(4), (n, 1, 1)), START_NS + np.arange(n) * 10**8)
    line.T[:, 0, 3] = 0.8 * np.arange(n)
    gnss = gnss_of(line, sigma=0.1)
    poses, _ = fuse(
        dataclasses.replace(gnss, latitude_deg=-gnss.latitude_deg),
        odometry=odometry_of(line, yaw_drift_deg_per_100m=0.1),
        world=line,
    )
    assert poses.frame == "world"
    assert ate(poses.T_world_lidar, line.T) < 1.0, "wrong place, right shape"
