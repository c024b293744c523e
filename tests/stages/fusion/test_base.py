"""A map that is extended: what stays, what gives way, what is said of sessions that hang on little."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.base import Base
from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import columns_of
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.fusion.base import separate, settled
from scanloom.stages.geometry.se3 import inverse, pose, se3_exp, se3_log, so3_exp
from tests.stages.fusion.drives import (
    START_NS,
    ate,
    gnss_of,
    imu_of,
    loops_of,
    odometry_of,
    parts,
    rectangle,
    session_of,
)

FIRST_DAY, SECOND_DAY = rectangle(0.97), rectangle(0.9, start_ns=START_NS + 86_400_000_000_000)
NOT_YET = Base.empty(frame="", georeference=None)


def fuse(
    old: str, new: str, loops: Loops, *, base: Base = NOT_YET, gnss: Gnss | None = None, late: Gnss | None = None,
    sessions: tuple[str, ...] | None = None, **settings: Any,
) -> tuple[dict[str, Poses], Graph]:  # fmt: skip
    """The first day as session `old`, the second as `new`."""
    named = sessions if sessions is not None else (old, new)
    worlds = {name: world for name, world in ((old, FIRST_DAY), (new, SECOND_DAY)) if name in named}
    nothing = Gnss.empty()
    fixes = {old: gnss if gnss is not None else nothing, new: late if late is not None else nothing}
    out = list(
        fusion(
            Settings(**settings),
            parts(**{name: session_of(name, world) for name, world in worlds.items()}),
            parts(**{name: odometry_of(world, seed=3 + (name == new)) for name, world in worlds.items()}),
            loops,
            parts(**{name: fixes[name] for name in worlds}),
            parts(**{name: imu_of(world) for name, world in worlds.items()}),
            base=parts(**{name: base if name == old else NOT_YET for name in worlds}),
        )
    )
    return {part.key: part.product for part in out[:-1]}, out[-1]


def ties(old: str, new: str, at_m: list[float], sigma: float = 0.03, seed: int = 9) -> Loops:
    """Loops between the days where the second one has gone so far; both start in the same place."""
    rng = np.random.default_rng(seed)
    i_of = np.flatnonzero(odometry_of(FIRST_DAY).keyframe)
    j_of = np.flatnonzero(odometry_of(SECOND_DAY).keyframe)
    rows = []
    for at in at_m:
        j = int(j_of[np.argmin(np.abs(SECOND_DAY.path[j_of] - at))])
        i = int(i_of[np.argmin(np.linalg.norm(FIRST_DAY.T[i_of, :3, 3] - SECOND_DAY.T[j, :3, 3], axis=1))])
        noise = se3_exp(rng.normal(0, 1, 6) * np.repeat([np.radians(0.1), sigma], 3))
        rows.append((old, i, new, j, inverse(FIRST_DAY.T[i]) @ SECOND_DAY.T[j] @ noise))
    return loops_of(rows)


def first_map(old: str = "a", gnss: Gnss | None = None) -> Base:
    poses, _ = fuse(old, "never", loops_of([]), gnss=gnss, sessions=(old,))
    return Base.of(poses[old])


def same(poses: Poses, base: Base) -> bool:
    """To the last bit, with the frame."""
    before = base.poses()
    columns = all(getattr(poses, c).tobytes() == getattr(before, c).tobytes() for c in columns_of(Poses))
    return columns and poses.attributes == before.attributes


def error_between(poses: dict[str, Poses], old: str, new: str) -> np.ndarray:
    """Error (n,) of the new session's places in the old map, m, by truth: the old map laid on truth as a whole."""
    a, b = poses[old].T_world_lidar, poses[new].T_world_lidar
    nearest = (
        np.linalg.norm(SECOND_DAY.T[:, None, :3, 3] - FIRST_DAY.T[None, ::5, :3, 3], axis=2).argmin(1) * 5
    )
    true = inverse(FIRST_DAY.T[nearest]) @ SECOND_DAY.T
    return np.asarray(np.linalg.norm((inverse(a[nearest]) @ b)[:, :3, 3] - true[:, :3, 3], axis=1))


EVERYWHERE = [5.0, 40.0, 80.0, 120.0, 160.0]


@pytest.mark.parametrize(("old", "new"), [("a", "b"), ("b", "a")])
@pytest.mark.parametrize("with_gnss", [True, False])
def test_rigid_keeps_every_bit_of_the_old_session(old: str, new: str, with_gnss: bool) -> None:
    gnss = gnss_of(FIRST_DAY) if with_gnss else None
    base = first_map(old, gnss)
    poses, graph = fuse(old, new, ties(old, new, EVERYWHERE), base=base, gnss=gnss)
    assert same(poses[old], base)
    assert poses[new].frame == base.frame and poses[new].georeference == base.georeference
    error = error_between(poses, old, new)
    assert 0.01 < np.sqrt(np.mean(error**2)) < 0.25
    assert not graph.warnings
    held = {key.split("/")[0] for key in graph.key_i[graph.kind == "base"]}
    assert held == {old}
    if with_gnss:
        assert not (graph.verdict[graph.kind == "gnss"] == "used").any()


def test_a_new_day_with_gnss_gives_way_to_the_map_it_joins() -> None:
    base = first_map("a", gnss_of(FIRST_DAY))
    late = gnss_of(SECOND_DAY, sigma=0.5, seed=7)
    poses, _ = fuse("a", "b", ties("a", "b", EVERYWHERE), base=base, gnss=gnss_of(FIRST_DAY), late=late)
    assert same(poses["a"], base)
    assert 0.005 < np.sqrt(np.mean(error_between(poses, "a", "b") ** 2)) < 0.2


def test_gnss_cannot_place_what_extends_a_map_without_a_place() -> None:
    base = first_map("a")
    poses, graph = fuse("a", "b", ties("a", "b", EVERYWHERE), base=base, late=gnss_of(SECOND_DAY))
    assert base.frame == "map" and poses["b"].frame == "map"
    assert np.sqrt(np.mean(error_between(poses, "a", "b") ** 2)) < 0.25
    verdicts = set(graph.verdict[graph.kind == "gnss"])
    assert "used" not in verdicts and any("no place on the Earth" in verdict for verdict in verdicts)


@pytest.mark.parametrize(
    ("at_m", "said"),
    [([5.0, 40.0], ""), ([5.0, 20.0], "one loop")],
    ids=["two apart", "two close by"],
)
def test_a_session_on_one_loop_is_named(at_m: list[float], said: str) -> None:
    _, graph = fuse("a", "b", ties("a", "b", at_m), base=first_map("a"))
    if said:
        (warning,) = graph.warnings
        assert said in warning and "session b" in warning and "drift" in warning
    else:
        assert not graph.warnings


def test_a_single_loop_is_told_whether_it_is_believed_or_not() -> None:
    """Nothing can confirm it: a solver that refuses it leaves the session without a place."""
    try:
        _, graph = fuse("a", "b", ties("a", "b", [5.0]), base=first_map("a"))
    except StageError as error:
        said = (error.where, "only one loop" in error.what, bool(error.next_step))
    else:
        (warning,) = graph.warnings
        said = ("session b", "one loop" in warning, "session b" in warning)
    assert said == ("session b", True, True)


def test_gnss_alone_holds_a_session_that_meets_no_other() -> None:
    gnss = gnss_of(FIRST_DAY)
    poses, graph = fuse(
        "a", "b", loops_of([]), base=first_map("a", gnss), gnss=gnss, late=gnss_of(SECOND_DAY)
    )
    (warning,) = graph.warnings
    assert "session b meets no other session" in warning and "GNSS alone" in warning
    assert np.sqrt(np.mean(error_between(poses, "a", "b") ** 2)) < 0.5


@pytest.mark.parametrize("extended", [True, False])
def test_sessions_that_never_meet_are_an_error(extended: bool) -> None:
    base = first_map("a") if extended else NOT_YET
    with pytest.raises(StageError, match="nothing ties this session") as error:
        fuse("a", "b", loops_of([]), base=base)
    assert error.value.where == "session b" and error.value.next_step


def test_a_map_is_not_extended_by_nothing() -> None:
    gnss = gnss_of(FIRST_DAY)
    with pytest.raises(StageError, match="nothing ties this session") as error:
        fuse("a", "b", loops_of([]), base=first_map("a", gnss), gnss=gnss)
    assert error.value.where == "session b"


def test_a_session_without_a_place_is_left_out_of_a_map_that_has_one() -> None:
    poses, graph = fuse("a", "b", loops_of([]), gnss=gnss_of(FIRST_DAY))
    assert set(poses) == {"a"} and poses["a"].frame == "world"
    (warning,) = graph.warnings
    assert "session b is left out" in warning and "GNSS" in warning
    assert not any(key.startswith("b/") for key in graph.key_i)


def test_of_sessions_without_a_place_the_largest_group_makes_the_map() -> None:
    lost, first, second = FIRST_DAY, FIRST_DAY, SECOND_DAY
    days = {"a": lost, "b": first, "c": second}
    out = list(
        fusion(
            Settings(),
            parts(**{name: session_of(name, world) for name, world in days.items()}),
            parts(**{name: odometry_of(world) for name, world in days.items()}),
            ties("b", "c", EVERYWHERE), parts(),
            parts(**{name: imu_of(world) for name, world in days.items()}),
        )
    )  # fmt: skip
    poses, graph = {part.key: part.product for part in out[:-1]}, out[-1]
    assert set(poses) == {"b", "c"}
    assert [w for w in graph.warnings if "session a is left out" in w]
    assert np.sqrt(np.mean(error_between(poses, "b", "c") ** 2)) < 0.25


def test_bases_in_different_frames_are_refused() -> None:
    one = first_map("a")
    other = dataclasses.replace(one, frame="world")
    with pytest.raises(StageError, match="different frames"):
        list(
            fusion(
                Settings(), parts(a=session_of("a", FIRST_DAY), b=session_of("b", FIRST_DAY)),
                parts(a=odometry_of(FIRST_DAY), b=odometry_of(FIRST_DAY)), loops_of([]), parts(), parts(),
                base=parts(a=one, b=other),
            )
        )  # fmt: skip


def test_new_poses_are_no_surer_than_the_map_they_lie_on() -> None:
    gnss = gnss_of(FIRST_DAY, sigma=0.5)
    base = first_map("a", gnss)
    poses, _ = fuse("a", "b", ties("a", "b", EVERYWHERE), base=base, gnss=gnss)
    at = np.linalg.norm(
        base.T_world_lidar[:, None, :3, 3] - poses["b"].T_world_lidar[None, ::50, :3, 3], axis=2
    )
    of_map = np.trace(base.covariance[at.argmin(axis=0), 3:, 3:], axis1=1, axis2=2)
    of_new = np.trace(poses["b"].covariance[::50, 3:, 3:], axis1=1, axis2=2)
    assert (of_new > 0.9 * of_map).all() and (of_new < 3.0 * of_map + 0.1).all()


# --- soft -----------------------------------------------------------------------------------------------------------


def test_soft_lets_old_poses_give_way_to_new_loops() -> None:
    gnss = gnss_of(FIRST_DAY)
    base = first_map("a")
    bent = dataclasses.replace(base, T_world_lidar=_bent(base.T_world_lidar))
    poses, graph = fuse("a", "b", ties("a", "b", EVERYWHERE), base=bent, extension="soft")
    before, after = ate(bent.T_world_lidar, FIRST_DAY.T), ate(poses["a"].T_world_lidar, FIRST_DAY.T)
    assert after < 0.8 * before
    assert poses["a"].frame == base.frame
    assert (graph.kind == "base").sum() == 1
    assert gnss is not None


def _bent(T: np.ndarray) -> np.ndarray:
    """A map whose far end is turned by some degrees: what a wrong loop leaves behind."""
    turn = so3_exp(np.column_stack((np.zeros((len(T), 2)), np.linspace(0, np.radians(4), len(T)))))
    return np.asarray(T[0] @ pose(turn, np.zeros(3)) @ inverse(T[0]) @ T)


def _straight(n: int = 1000) -> Base:
    """100 m in steps of 0.1 m."""
    T = pose(np.eye(3), np.column_stack((0.1 * np.arange(n), np.zeros((n, 2)))))
    return Base(
        np.arange(n), np.arange(n) * 100_000_000, T, np.broadcast_to(np.eye(6), (n, 6, 6)).copy(), np.ones(n, bool),
        "map", None,
    )  # fmt: skip


def _moved(base: Base, aside_m: np.ndarray) -> Poses:
    T = base.T_world_lidar.copy()
    T[:, 1, 3] += aside_m
    return dataclasses.replace(base.poses(), T_world_lidar=T, covariance=2.0 * base.covariance)


def test_spans_within_the_deadband_keep_every_bit_and_nothing_tears() -> None:
    base = _straight()
    aside = np.clip((base.T_world_lidar[:, 0, 3] - 30.0) / 50.0, 0, 1) * 0.1
    out = settled(_moved(base, aside), base, rigid=False, deadband_m=0.02)
    x = base.T_world_lidar[:, 0, 3]
    stays = x < 20.0
    assert out.T_world_lidar[stays].tobytes() == base.T_world_lidar[stays].tobytes()
    assert (out.covariance[stays] == base.covariance[stays]).all()
    got = out.T_world_lidar[:, 1, 3]
    assert np.allclose(got[x > 50.5], aside[x > 50.5], atol=1e-12)
    assert (out.covariance[x > 60] == 2.0 * base.covariance[x > 60]).all()
    assert np.abs(np.diff(got)).max() < 0.002


@pytest.mark.parametrize(("aside_m", "stays"), [(0.0199, True), (0.0201, False)])
def test_deadband_at_its_edge(aside_m: float, stays: bool) -> None:
    base = _straight(150)
    out = settled(_moved(base, np.full(150, aside_m)), base, rigid=False, deadband_m=0.02)
    assert (out.T_world_lidar == base.T_world_lidar).all() == stays
    assert np.allclose(out.T_world_lidar[:, 1, 3], 0.0 if stays else aside_m)


def test_a_turn_counts_by_what_it_moves_far_away() -> None:
    base = _straight(150)
    turned = base.T_world_lidar @ se3_exp(np.array([0.0, 0.0, 0.002, 0.0, 0.0, 0.0]))
    out = settled(dataclasses.replace(base.poses(), T_world_lidar=turned), base, rigid=False, deadband_m=0.02)
    assert np.allclose(se3_log(inverse(out.T_world_lidar) @ turned), 0.0, atol=1e-12)


def test_scans_that_the_map_lacks_are_where_the_solution_says() -> None:
    base = _straight(300)
    solved = _moved(base, np.zeros(300))
    fewer = base.take(np.flatnonzero(np.arange(300) % 7 != 3))
    out = settled(solved, fewer, rigid=False, deadband_m=0.02)
    assert np.allclose(out.T_world_lidar, solved.T_world_lidar)


@pytest.mark.parametrize(
    ("places", "count"), [([], 0), ([3.0], 1), ([0, 19, 20], 1), ([0, 20.5], 2), ([50, 0, 21, 42], 3)]
)
def test_loops_close_together_count_once(places: list[float], count: int) -> None:
    assert separate(places) == count
