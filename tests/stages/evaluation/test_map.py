"""Evaluation of loops, GNSS, several sessions and blind stretches: known faults go in, the same figures come out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.evaluation import Metrics
from scanloom.schemas.product import Parts
from scanloom.schemas.tracks import Gnss
from scanloom.stages.evaluation import evaluation
from scanloom.stages.evaluation.stage import Settings
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import F8, pose, se3_exp, so3_exp
from tests.stages.evaluation.driving import HERE, figures_of, laps
from tests.stages.mapping import (
    fixes_graph,
    graph_of,
    loops_of,
    odometry_of,
    poses_of,
    session_of,
    stamps,
    truth_of,
)

# --- GNSS ---


def gnss_of(positions: F8, status: np.ndarray) -> Gnss:
    where = world_to_geodetic(HERE, positions)
    n = len(positions)
    return Gnss(
        stamp_ns=stamps(n), latitude_deg=where[:, 0].copy(), longitude_deg=where[:, 1].copy(), height_m=where[:, 2].copy(),
        covariance_m2=np.tile(np.eye(3), (n, 1, 1)), status=status.astype(np.int8), satellites=np.full(n, 9, np.int16),
    )  # fmt: skip


def test_fixes_are_told_apart_by_what_the_receiver_said() -> None:
    T = laps(100)
    status = np.repeat([2, 0, -1], [60, 30, 10])
    off = np.zeros((100, 3))
    off[:60, 0] = np.linspace(0.0, 1.0, 60)
    off[60:90] = [3.0, 4.0, 50.0]
    off[90:] = np.nan
    verdicts = (
        ["used"] * 45 + ["sigma 7 m"] * 5 + ["sigma 8 m"] * 10 + ["used"] * 3 + ["the receiver's lie"] * 37
    )
    poses = {"a": poses_of(T, georeference=HERE.model_dump())}
    graph = fixes_graph(T[:, :3, 3], off, verdicts)
    figures = figures_of(T=T, poses=poses, graph=graph, gnss=gnss_of(T[:, :3, 3], status))
    assert (figures["gnss.fixes"], figures["gnss.used"]) == (100, 48)
    assert figures["gnss.left_out.sigma_m"] == 15
    assert figures["gnss.left_out.the_receivers_lie"] == 37
    assert figures["gnss.status_2.used_share"] == 0.75
    assert figures["gnss.status_2.residual_median_m"] == pytest.approx(0.5)
    assert figures["gnss.status_2.residual_p95_m"] == pytest.approx(0.95)
    assert figures["gnss.status_0.used_share"] == 0.1
    assert figures["gnss.status_0.residual_median_m"] == 5.0  # height is left out
    assert figures["gnss.status_-1.fixes"] == 10
    assert "gnss.status_-1.residual_median_m" not in figures


def test_wrong_fixes_are_known_by_truth_whatever_the_solution_makes_of_them() -> None:
    """The map is 2 m off to the north; fixes are where they are, and residuals are to the map's antenna."""
    T = laps(40)
    moved = T.copy()
    moved[:, 1, 3] += 2.0
    error = np.zeros((40, 3))
    error[10:20, 0] = 5.1  # wrong: claimed within a metre
    error[20:30, 0] = 4.9  # five times what is claimed, and not more
    error[35:, :] = np.nan
    residual = np.array([0.0, 2.0, 0.0]) - error
    verdicts = ["used"] * 12 + ["lies"] * 28
    graph = fixes_graph(T[:, :3, 3] + error, residual, verdicts)
    truth = {"a": replace(truth_of(T), georeference=HERE.model_dump())}
    poses = {"a": poses_of(moved, georeference=HERE.model_dump())}
    gnss = gnss_of(T[:, :3, 3], np.full(40, 2))
    figures = figures_of(T=T, truth=truth, poses=poses, graph=graph, gnss=gnss)
    assert figures["gnss.wrong_fixes"] == 10
    assert figures["gnss.wrong_used"] == 2
    assert figures["gnss.used_error_median_m"] == pytest.approx(0.0, abs=1e-6)
    assert figures["gnss.used_error_p95_m"] == pytest.approx(5.1, abs=1e-6)
    sure = replace(
        gnss, covariance_m2=np.zeros((40, 3, 3))
    )  # a receiver that does not tell: more than a metre is wrong
    assert figures_of(T=T, truth=truth, poses=poses, graph=graph, gnss=sure)["gnss.wrong_fixes"] == 20
    late = {"a": truth["a"].take(slice(30, None))}
    assert figures_of(T=T, truth=late, poses=poses, graph=graph, gnss=gnss)["gnss.wrong_fixes"] == 0
    nowhere = figures_of(T=T, poses=poses, graph=graph, gnss=gnss)
    assert "gnss.wrong_fixes" not in nowhere


def test_without_a_georeference_fixes_have_no_residuals() -> None:
    T = laps(20)
    graph = fixes_graph(T[:, :3, 3], np.ones((20, 3)), ["too few good fixes"] * 20)
    figures = figures_of(T=T, graph=graph, gnss=gnss_of(T[:, :3, 3], np.zeros(20)))
    assert figures["gnss.used"] == 0
    assert figures["gnss.status_0.used_share"] == 0.0
    assert not [name for name in figures if "residual" in name]


def test_a_session_without_gnss_has_no_figures_of_it() -> None:
    assert not [name for name in figures_of(T=laps(20)) if name.startswith("gnss")]


# --- errors on the Earth ---


def test_the_error_on_the_earth_is_that_of_the_place() -> None:
    T = laps(200)
    elsewhere = georeference(48.138, 11.577, 565.0)
    truth = {"a": replace(truth_of(T), georeference=elsewhere.model_dump())}
    origin = world_to_geodetic(HERE, [[0.0, 0.0, 0.0]])[0]
    assert origin == pytest.approx([48.137, 11.576, 560.0])
    from scanloom.stages.geometry.geodesy import between_worlds

    right = between_worlds(HERE, elsewhere) @ T
    moved = right.copy()
    moved[:, 0, 3] += 2.0
    for poses, want in ((right, 0.0), (moved, 2.0)):
        figures = figures_of(T=T, truth=truth, poses={"a": poses_of(poses, georeference=HERE.model_dump())})
        assert figures["fusion.absolute_rmse_m"] == pytest.approx(want, abs=1e-6)
        assert figures["fusion.ate_rmse_m"] < 1e-6
    local = figures_of(T=T, truth=truth, poses={"a": poses_of(right)})
    assert "fusion.absolute_rmse_m" not in local
    assert "fusion.absolute_rmse_m" not in figures_of(
        T=T, poses={"a": poses_of(right, georeference=HERE.model_dump())}
    )


@pytest.mark.parametrize(("sure", "want"), [(1.0, 3.0), (4.0, 12.0), (0.25, 0.75)])
def test_marginals_are_held_against_the_errors_there_are(sure: float, want: float) -> None:
    """Errors drawn in the LiDAR's frame from a slanted covariance; the map says it is `sure` times as certain."""
    T = laps(900)
    spread = np.array([[0.3, 0.0, 0.0], [0.1, 0.1, 0.0], [0.0, 0.05, 0.5]])
    xi = np.zeros((900, 6))
    xi[:, 3:] = np.random.default_rng(0).normal(size=(900, 3)) @ spread.T
    covariance = np.zeros((900, 6, 6))
    covariance[:, 3:, 3:] = spread @ spread.T / sure
    poses = replace(poses_of(T @ se3_exp(xi), georeference=HERE.model_dump()), covariance=covariance)
    truth = {"a": replace(truth_of(T), georeference=HERE.model_dump())}
    assert figures_of(T=T, truth=truth, poses={"a": poses})["fusion.nees_translation"] == pytest.approx(
        want, rel=0.15
    )


def test_marginals_that_nobody_knows_have_no_honesty() -> None:
    T = laps(30)
    poses = replace(poses_of(T), covariance=np.full((30, 6, 6), np.nan))
    assert "fusion.nees_translation" not in figures_of(T=T, poses={"a": poses})


# --- several sessions ---


def two(T_a: F8, T_b: F8, *, known: bool = True) -> dict[str, Any]:
    """Two sessions whose truths share a frame when `known`."""
    place = HERE.model_dump() if known else None
    truth = {n: replace(truth_of(T), georeference=place) for n, T in (("a", T_a), ("b", T_b))}
    return {"T": {"a": T_a, "b": T_b}, "truth": truth}


def test_sessions_that_lie_wrong_to_each_other_are_seen() -> None:
    T_a, T_b = laps(300), laps(300, 2.0)
    shifted = pose(so3_exp([0, 0, 0.0]), [0.3, 0.4, 0.0]) @ T_b
    figures = figures_of(**two(T_a, T_b), poses={"a": poses_of(T_a), "b": poses_of(shifted)})
    assert figures["fusion.inter_session_rmse_m"] == pytest.approx(0.5, abs=1e-6)
    assert figures["fusion.inter_session_rmse_deg"] < 1e-6
    both_moved = {n: poses_of(pose(so3_exp([0, 0, 1.0]), [9, 9, 0]) @ T) for n, T in (("a", T_a), ("b", T_b))}
    assert figures_of(**two(T_a, T_b), poses=both_moved)["fusion.inter_session_rmse_m"] < 1e-6


@pytest.mark.parametrize(("beside_m", "meets"), [(4.99, True), (5.01, False)])
def test_sessions_are_compared_where_both_pass_within_five_metres(beside_m: float, meets: bool) -> None:
    figures = figures_of(**two(laps(200), laps(200, beside_m)))
    assert ("fusion.inter_session_rmse_m" in figures) == meets


def test_truths_in_frames_of_their_own_say_nothing_of_each_other() -> None:
    T = laps(200)
    loops = loops_of(T, [(50, 50)], [0.0])
    loops = replace(loops, session_j=np.array(["b"], object))
    apart = figures_of(**two(T, T, known=False), loops=loops)
    assert "fusion.inter_session_rmse_m" not in apart
    assert "loops.precision" not in apart
    assert "loops.recall" not in apart
    together = figures_of(**two(T, T), loops=loops)
    assert together["loops.between_sessions"] == apart["loops.between_sessions"] == 1
    assert together["loops.precision"] == 1.0


def test_what_an_earlier_session_saw_ought_to_be_found() -> None:
    T = laps(200)
    given = two(T, T)
    later = given["truth"]["b"].stamp_ns + 3_600_000_000_000
    given["truth"]["b"] = replace(given["truth"]["b"], stamp_ns=later)
    odometry = Parts(
        [
            ((("session", "a"),), odometry_of(T)),
            ((("session", "b"),), replace(odometry_of(T), stamp_ns=later)),
        ]
    )
    pairs = [(int(k), int(k)) for k in range(5, 100, 10)]
    loops = replace(loops_of(T, pairs, [0.0] * 10), session_j=np.array(["b"] * 10, object))
    *_, metrics = evaluation(
        Settings(), Parts([((("session", n),), session_of(n)) for n in "ab"]),
        Parts([((("session", n),), t) for n, t in given["truth"].items()]), odometry,
        Parts([((("session", "a"),), poses_of(T)), ((("session", "b"),), replace(poses_of(T), stamp_ns=later))]),
        loops, graph_of(loops), Parts([]), Parts([]),
    )  # fmt: skip
    assert isinstance(metrics, Metrics)
    figures = dict(zip(metrics.name, metrics.value))
    assert figures["loops.recall"] == pytest.approx(
        0.53, abs=0.006
    )  # of 200 scans of b, 0 to 105 have a loop within 10 m


# --- blind stretches ---


def test_blind_stretches_are_measured_and_segments_counted() -> None:
    T = laps(200)
    p = np.ones((200, 6))
    p[0] = 0.0  # the first scan has no motion to be seen
    p[50:60, 3] = 0.2
    p[100:140, 0] = 0.4
    odometry = replace(odometry_of(T), direction_p=p)
    figures = figures_of(T=T, odometry=odometry)
    assert figures["odometry.degenerate_share"] == pytest.approx(50 / 200)
    assert figures["odometry.degenerate_longest_m"] == pytest.approx(40.0, abs=0.01)
    assert "odometry.segments" not in figures
    split = replace(odometry, segment=np.repeat([0, 1, 2], [60, 60, 80]).astype(np.int32))
    assert figures_of(T=T, odometry=split)["odometry.segments"] == 3


def test_one_scan_is_no_stretch() -> None:
    figures = figures_of(T=np.eye(4)[None])
    assert figures["odometry.degenerate_share"] == 0.0
    assert figures["odometry.degenerate_longest_m"] == 0.0
