"""Evaluation: known errors go in, the same errors come out."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.evaluation import ErrorTrack, Metrics
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.rig import ImuCheck, SensorCheck, WheelCheck
from scanloom.schemas.tiles import Tile
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.evaluation import evaluation
from scanloom.stages.evaluation.stage import Settings
from scanloom.stages.geometry.se3 import F8, se3_exp
from tests.stages.mapping import (
    circle,
    drifting,
    graph_of,
    loops_of,
    odometry_of,
    one,
    poses_of,
    session_of,
    truth_of,
)
from tests.tiles import tile_of


def run(
    true: F8, estimate: F8, *, fused: F8 | None = None, truth: Truth | None = None, loops: Loops | None = None,
    tiles: Parts[Tile] | None = None, graph: Graph | None = None, gnss: Gnss | None = None, odometry: Odometry | None = None,
) -> tuple[dict[str, float], list[Part[ErrorTrack]], Metrics]:  # fmt: skip
    loops = Loops.empty() if loops is None else loops
    made = list(
        evaluation(
            Settings(), one(session_of()), one(truth_of(true) if truth is None else truth),
            one(odometry_of(estimate) if odometry is None else odometry), one(poses_of(true if fused is None else fused)),
            loops, graph_of(loops) if graph is None else graph, one(Gnss.empty() if gnss is None else gnss),
            Parts([]) if tiles is None else tiles,
        )
    )  # fmt: skip
    metrics = made[-1]
    assert isinstance(metrics, Metrics)
    return dict(zip(metrics.name, metrics.value)), made[:-1], metrics  # type: ignore[return-value]


def test_drift_in_gives_the_same_drift_out() -> None:
    T = circle(1000, radius_m=1e9)
    estimate = drifting(T, scale=1.01)
    figures, tracks, _ = run(T, estimate, fused=T)
    assert figures["odometry.kitti_t_rel_percent"] == pytest.approx(1.0, abs=0.02)
    assert figures["odometry.path_length_m"] == pytest.approx(1.01 * figures["truth.path_length_m"], rel=1e-6)
    assert figures["fusion.ate_rmse_m"] < 1e-6
    assert figures["odometry.ate_rmse_m"] == pytest.approx(
        9.99 / np.sqrt(12), rel=0.01
    )  # stretched about its middle
    assert figures["odometry.rpe10_m"] == pytest.approx(0.1, abs=0.011)
    (track,) = tracks
    assert track.key == "a"
    assert track.product.travelled_m[-1] == pytest.approx(figures["truth.path_length_m"])
    assert track.product.odometry_error_m[0] < 1e-9
    assert track.product.odometry_error_m[-1] == pytest.approx(9.99, rel=0.01)


def test_scans_outside_the_truth_are_left_out_and_counted() -> None:
    T = circle(300)
    truth = truth_of(T).take(slice(50, 251))
    figures, tracks, _ = run(T, T, truth=truth)
    assert figures["truth.scans"] == 201
    assert figures["truth.scans_outside"] == 99
    assert len(tracks[0].product) == 201
    assert figures["fusion.ate_rmse_m"] < 1e-9


def test_truth_between_scans_is_interpolated() -> None:
    T = circle(301, step_m=0.5)
    sparse = truth_of(T).take(slice(0, None, 5))
    figures, _, _ = run(T, T, truth=sparse)
    assert 0 < figures["fusion.ate_rmse_m"] < 0.02  # sagitta of 2.5 m on a radius of 80 m is 1 cm


def test_without_truth_there_are_no_errors() -> None:
    T = circle(50)
    figures, tracks, metrics = run(T, T, truth=Truth.empty(source=""))
    assert tracks == []
    assert not [
        name
        for name in figures
        if ".ate_" in name or "rpe" in name or "kitti" in name or name.startswith("truth")
    ]
    assert figures["odometry.scans"] == 50
    assert figures["fusion.georeferenced"] == 0.0
    assert set(metrics.scope) == {"session", "map"}


def test_short_paths_say_why_they_have_no_kitti_figures() -> None:
    T = circle(40)
    figures, _, metrics = run(T, T)
    assert "odometry.kitti_t_rel_percent" not in figures
    method = metrics.method[list(metrics.name).index("truth.path_length_m")]
    assert "100 m" in method


def test_false_loops_lower_precision_and_missed_ones_recall() -> None:
    T = circle(1000)  # one lap is 503 scans
    pairs = [(10, 513), (200, 703), (400, 903)]
    figures, _, _ = run(T, T, loops=loops_of(T, pairs, [0.1, 0.49, 3.0]))
    assert figures["loops.accepted"] == 3
    assert figures["loops.precision"] == pytest.approx(2 / 3)
    assert 0.05 < figures["loops.recall"] < 0.12  # two stretches of 21 scans of the 500 of the second lap


def test_loops_between_sessions_or_outside_the_truth_are_not_judged() -> None:
    T = circle(1000)
    loops = loops_of(T, [(10, 513)], [0.0])
    other = Loops(**{**vars(loops), "session_j": np.array(["b"], object)})
    assert "loops.precision" not in run(T, T, loops=other)[0]
    assert "loops.precision" not in run(T, T, loops=loops, truth=truth_of(T).take(slice(100, None)))[0]


def test_unreliable_scans_are_counted() -> None:
    T = circle(30)
    reliable = np.ones(30, bool)
    reliable[3:5] = False
    figures, _, _ = run(T, T, truth=Truth.empty(source=""), odometry=odometry_of(T, reliable=reliable))
    assert figures["odometry.unreliable_scans"] == 2


def test_what_was_measured_of_the_sensors_is_a_figure_and_what_was_not_is_none() -> None:
    T = circle(30)
    check = SensorCheck(
        imu=ImuCheck(verdict="corrected", measured_offset_s=0.04),
        wheel=WheelCheck(verdict="contradicts", measured_ratio=0.5),
    )
    *_, metrics = evaluation(
        Settings(), one(session_of()), one(Truth.empty(source="")), one(odometry_of(T)), one(poses_of(T)), Loops.empty(),
        Graph.empty(), one(Gnss.empty()), Parts([]), one(check),
    )  # fmt: skip
    assert isinstance(metrics, Metrics)
    figures = dict(zip(metrics.name, metrics.value))
    assert figures["sensors.imu_clock_offset_s"] == 0.04
    assert figures["sensors.wheel_ratio"] == 0.5
    assert figures["sensors.contradicting"] == 1
    assert "sensors.wheel_clock_offset_s" not in figures


def test_the_sample_is_spread_over_all_tiles_and_always_the_same() -> None:
    rng = np.random.default_rng(0)
    parts = Parts(
        [
            (
                (("tile", f"{i}_0"),),
                tile_of(rng.uniform(0, 10, (30_000, 3)) * [1, 1, 0.01], offset_m=(50.0 * i, 0.0, 0.0)),
            )
            for i in range(3)
        ]
    )
    T = circle(20)
    (first, _, a), (_, _, b) = run(T, T, tiles=parts), run(T, T, tiles=parts)
    assert a.to_arrow().equals(b.to_arrow())
    assert first["map.points"] == 90_000
    assert first["map.tiles"] == 3
    assert first["map.area_m2"] == 300
    assert first["map.mme_r1.0_share"] == 1.0


def test_one_scan_and_no_tiles_still_give_metrics() -> None:
    T = np.eye(4)[None]
    figures, tracks, _ = run(T, T)
    assert figures["odometry.scans"] == 1
    assert figures["map.points"] == 0
    assert len(tracks) == 1


def test_rotation_errors_show_in_degrees() -> None:
    T = circle(200)
    estimate = T @ se3_exp(np.random.default_rng(0).normal(0, [0.01] * 3 + [0.0] * 3, (200, 6)))
    figures, _, _ = run(T, estimate)
    assert 1.0 < figures["odometry.rpe5_deg"] < 1.8  # 0.01 rad, three axes, two ends: 1.4 deg


def test_a_blurred_map_has_more_entropy() -> None:
    rng = np.random.default_rng(0)
    sharp = np.column_stack((rng.uniform(0, 20, (100_000, 2)), rng.normal(0, 0.02, 100_000)))
    double = sharp + np.array([0, 0, 0.1]) * (rng.random(len(sharp)) < 0.5)[:, None]
    T = circle(20)
    values = [run(T, T, tiles=one_tile(points))[0]["map.mme_r0.5_nat"] for points in (sharp, double)]
    assert 0.4 < values[1] - values[0] < 1.2  # ln of the ratio of the spreads: 0.05 to 0.02 is 0.98


def one_tile(points: F8) -> Parts[Tile]:
    return Parts([((("tile", "0_0"),), tile_of(points))])
