"""KITTI 00: 3.7 km of real odometry with real GNSS, and what becomes of the map when that GNSS lies, breaks off or is late.

    python -m benchmarks.kitti_gnss --data ../shared/data

Odometry is KISS-ICP's, positions come at about 1 Hz in a local metric frame on another clock, truth is KITTI's. The fusion
gets all of it as the products a log would give and runs as `map` runs it, with default settings. It is told neither where
the antenna stands nor how late the clock is: only the large difference of epochs is taken out, by the two logs' own starts.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import kitti_peers
from benchmarks.kitti_scenarios import Scenario, scenarios
from benchmarks.scores import Figure
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.geometry.alignment import absolute_errors, rms
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import F8, inverse, matrix_from_quaternion, pose, so3_log

FOLDER = "kitti_00_trajectory"
START_NS = 1_317_646_534_000_000_000
ORIGIN = georeference(48.98, 8.39, 116.0)
"""Any place near Karlsruhe: the file's frame has no georeference."""
STEP_SIGMA = np.repeat([np.radians(0.02), 0.02], 3)
"""Of a motion between two scans, rad and m: KISS-ICP states none. The fusion estimates the rest."""
FIX_SIGMA_M = (0.5, 0.5, 1.0)
KEYFRAME_M, KEYFRAME_RAD = 1.0, 0.2
"""As odometry chooses keyframes."""
BLAMED = ("disagrees", "switched off", "height jumps", "contradict")
"""How verdicts begin, or what they hold, that call a fix wrong; others only say that it is not needed or came too early."""
ALIGNED = "RMSE over all 4541 poses after rigid alignment to truth"


@dataclass(frozen=True)
class Recording:
    """Products of the drive, positions (m, 3) of its fixes in the metric frame, and true poses (n, 4, 4)."""

    session: Session
    odometry: Odometry
    stamp_ns: NDArray[np.int64]
    position_m: F8
    truth: F8

    def gnss(self, position_m: F8, kept: NDArray[np.bool_] | None = None) -> Gnss:
        """Fixes at positions (m, 3) of the metric frame, all of them reported as good."""
        rows = np.arange(len(position_m)) if kept is None else np.flatnonzero(kept)
        geodetic, n = world_to_geodetic(ORIGIN, position_m[rows]), len(rows)
        return Gnss(
            stamp_ns=self.stamp_ns[rows],
            latitude_deg=geodetic[:, 0].copy(),
            longitude_deg=geodetic[:, 1].copy(),
            height_m=geodetic[:, 2].copy(),
            covariance_m2=np.tile(np.diag(np.square(FIX_SIGMA_M)), (n, 1, 1)),
            status=np.zeros(n, np.int8),
            satellites=np.full(n, -1, np.int16),
        )


def read(data: Path) -> Recording:
    """The drive as products: axes forward, left, up; both clocks start at zero."""
    folder = data / FOLDER
    track = np.loadtxt(folder / "kiss_icp_tum.txt")
    fixes = np.loadtxt(folder / "gnss_enu_1hz.csv", delimiter=",", skiprows=1)
    odometry = _odometry(_stamps(track[:, 0]), _forward_left_up(track))
    return Recording(
        session=_session(odometry),
        odometry=odometry,
        stamp_ns=_stamps(fixes[:, 0] - fixes[0, 0]),
        position_m=fixes[:, 1:],
        truth=_forward_left_up(np.loadtxt(folder / "truth_tum.txt")),
    )


def _stamps(seconds: F8) -> NDArray[np.int64]:
    return START_NS + np.round(seconds * 1e9).astype(np.int64)


def _forward_left_up(tum: F8) -> F8:
    """Camera poses (n, 4, 4) of a TUM file (x right, y down, z forward) with axes forward, left, up."""
    axes = pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    T = pose(matrix_from_quaternion(tum[:, [7, 4, 5, 6]]), tum[:, 1:4])
    return np.asarray(axes @ T @ inverse(axes))


def _odometry(stamp_ns: NDArray[np.int64], T: F8) -> Odometry:
    n = len(T)
    return Odometry(
        scan_index=np.arange(n),
        stamp_ns=stamp_ns,
        T_odom_lidar=T,
        covariance=np.tile(np.diag(STEP_SIGMA**2), (n, 1, 1)),
        inlier_ratio=np.ones(n),
        rmse_m=np.zeros(n),
        degeneracy_d=np.ones(n),
        degeneracy_e=np.zeros(n),
        direction_p=np.ones((n, 6)),
        weak_directions=np.tile(np.eye(6), (n, 1, 1)),
        keyframe=_keyframes(T),
        reliable=np.ones(n, bool),
        segment=np.zeros(n, np.int32),
    )


def _keyframes(T: F8) -> NDArray[np.bool_]:
    chosen, last = np.zeros(len(T), bool), T[0]
    chosen[[0, -1]] = True
    for k, here in enumerate(T):
        step = inverse(last) @ here
        if np.linalg.norm(step[:3, 3]) >= KEYFRAME_M or np.linalg.norm(so3_log(step[:3, :3])) >= KEYFRAME_RAD:
            chosen[k], last = True, here
    return chosen


def _session(odometry: Odometry) -> Session:
    return Session(
        name="00",
        format="kitti odometry",
        start_ns=int(odometry.stamp_ns[0]),
        end_ns=int(odometry.stamp_ns[-1]),
        scan_count=len(odometry),
        point_count=0,
        scan_rate_hz=10.0,
        beams=64,
        point_time="none",
        topics=(),
        extrinsics=(),
        problems=(),
        complete=True,
    )


@dataclass(frozen=True)
class Outcome:
    """What the fusion made of a scenario: error, and of the fixes it calls wrong how many are, and how many of those."""

    ate_m: float
    precision: float
    recall: float
    remarks: Sequence[str]


def figures(data: Path) -> Iterator[Figure]:
    """Every scenario: mean and worst over its seeds or places, and the verdicts on moved fixes."""
    recording = read(data)
    alone = rms(absolute_errors(recording.truth, recording.odometry.T_odom_lidar))
    yield Figure("kitti_00.odometry.ate_rmse_m", alone, "m", "run", f"KISS-ICP's odometry alone; {ALIGNED}")
    time_s = (recording.stamp_ns - recording.stamp_ns[0]) * 1e-9
    for name, group in groupby(scenarios(time_s, recording.position_m), key=lambda s: s.name):
        chosen = list(group)
        outcomes = [run(recording, scenario) for scenario in chosen]
        yield from _ours(name, chosen, outcomes)
        yield from _peers(name, chosen, recording)


def run(recording: Recording, scenario: Scenario, settings: Settings | None = None) -> Outcome:
    """The fusion on a scenario, with default settings unless told otherwise."""
    gnss = recording.gnss(scenario.position_m, scenario.kept)
    *parts, graph = fusion(
        settings or Settings(),
        _one(recording.session),
        _one(recording.odometry),
        Loops.empty(),
        _one(gnss),
        _one(Imu.empty()),
    )
    if not isinstance(graph, Graph) or not isinstance(parts[0], Part):
        raise TypeError("the fusion yields poses, then its graph")
    wrong = named(graph)
    moved = scenario.moved[scenario.kept]
    right = float((wrong & moved).sum())
    return Outcome(
        rms(absolute_errors(recording.truth, parts[0].product.T_world_lidar)),
        right / wrong.sum() if wrong.any() else float("nan"),
        right / moved.sum() if moved.any() else float("nan"),
        graph.remarks,
    )


def named(graph: Graph) -> NDArray[np.bool_]:
    """Fixes (m,) whose verdict calls them wrong."""
    verdicts = graph.verdict[graph.kind == "gnss"]
    return np.array([any(word in str(verdict) for word in BLAMED) for verdict in verdicts], bool)


def _one(product: Session | Odometry | Gnss | Imu) -> Parts[Any]:
    return Parts([((("session", "00"),), product)])


def _ours(name: str, chosen: Sequence[Scenario], outcomes: Sequence[Outcome]) -> Iterator[Figure]:
    place, words = f"kitti_00.{name}", chosen[0].words
    errors = [o.ate_m for o in outcomes]
    count = f"; mean of {len(errors)}" if len(errors) > 1 else ""
    yield Figure(f"{place}.ate_rmse_m", float(np.mean(errors)), "m", "run", f"{words}; {ALIGNED}{count}")
    if len(errors) > 1:
        yield Figure(f"{place}.ate_rmse_worst_m", max(errors), "m", "run", f"{words}; worst of {len(errors)}")
    if chosen[0].moved.any():
        for kind, how in (
            ("precision", "of the fixes whose verdict calls them wrong, share that was moved"),
            ("recall", "of all moved fixes, however little, share that a verdict calls wrong"),
        ):
            values = [float(getattr(o, kind)) for o in outcomes]
            yield Figure(f"{place}.{kind}", float(np.mean(values)), "", "run", f"{how}{count}")
            yield Figure(f"{place}.{kind}_worst", min(values), "", "run", f"{how}; worst of {len(values)}")


def _peers(name: str, chosen: Sequence[Scenario], recording: Recording) -> Iterator[Figure]:
    odometry = recording.odometry
    for method in kitti_peers.METHODS:
        errors = []
        for scenario in chosen:
            rows = np.flatnonzero(scenario.kept)
            T = kitti_peers.solve(
                method,
                odometry.T_odom_lidar,
                odometry.stamp_ns,
                recording.stamp_ns[rows],
                scenario.position_m[rows],
            )
            errors.append(rms(absolute_errors(recording.truth, T)))
        how = f"{chosen[0].words}; GTSAM, all fixes, clock offset of {kitti_peers.CLOCK_OFFSET_S} s given; mean of {len(errors)}"
        yield Figure(f"kitti_00.{name}.{method}.ate_rmse_m", float(np.mean(errors)), "m", "run", how)


def main(words: Sequence[str] | None = None) -> None:
    """The figures as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the real data")
    options = parser.parse_args(words)
    print(json.dumps([figure.row() for figure in figures(options.data)], indent=1))


if __name__ == "__main__":
    main()
