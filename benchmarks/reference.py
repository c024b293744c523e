"""A reference trajectory where truth is too coarse: all scans of a log registered to each other, joined in one graph.

GNSS/INS of KITTI raw is good to 0.3 to 0.5 m in position and 0.03 to 0.07 m/s in velocity, so over 10 m of path it is off by
more than any of the systems. Scans are therefore registered pairwise, up to thirty scans apart, by small_gicp's GICP on dense
points (not by our kernel, and not scan to map as any of the systems), and all pairs are averaged in a pose graph. Each scan
is compensated by the graph's own motion. The same procedure on a simulated drive tells how good it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.sequences import Recording
from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.compensation import compensate
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log

APART = (1, 2, 4, 8, 15, 25)
"""Scans that are registered to each other are so many scans apart."""
ROUNDS = 2
VOXEL_M, NEIGHBOURS, REACH_M, RANGE_M = 0.25, 15, 0.6, 70.0
STD_RAD, STD_M = 5e-4, 0.01
TRUSTED_M = 0.1
"""Truth whose own accuracy figure is worse than this is not used for errors over short stretches."""


def refine(recording: Recording, T: F8) -> Truth:
    """Reference poses at the scans' reference times, from poses T (n, 4, 4) that are roughly right."""
    scans = [scan for part in recording.parts(Scans) for scan in part]
    stamp_ns = np.array([scan.reference_ns for scan in scans], np.int64)
    still = MotionTrack.build(Imu.empty(), Wheel.empty(), recording.one(Session))
    for _ in range(ROUNDS):
        clouds = [_cloud(scan, twist, still) for scan, twist in zip(scans, twists(stamp_ns, T))]
        T = _joined(T, _pairs(clouds, T))
    source = "registration of every scan with its neighbours in time, joined in a pose graph; made for this comparison"
    return Truth(stamp_ns=stamp_ns, T_truth_lidar=T, source=source)


def twists(stamp_ns: np.ndarray, T: F8) -> F8:
    """(n, 6) mean motion per second from the scan before to the scan after, in the scan's frame."""
    before, after = np.maximum(np.arange(len(T)) - 1, 0), np.minimum(np.arange(len(T)) + 1, len(T) - 1)
    seconds = 1e-9 * (stamp_ns[after] - stamp_ns[before])
    motion: F8 = se3_log(inverse(T[before]) @ T[after]) / seconds[:, None]
    return motion


@dataclass(frozen=True)
class _Cloud:
    points: object
    tree: object


@dataclass(frozen=True)
class _Edge:
    i: int
    j: int
    T_i_j: F8


def _cloud(scan: Scan, twist: F8, still: MotionTrack) -> _Cloud:
    import small_gicp

    moved = compensate(scan.stamp_ns, scan.x_m, scan.y_m, scan.z_m, scan.reference_ns, still, twist)
    points = np.column_stack(moved)
    points = points[np.linalg.norm(points, axis=1) < RANGE_M].astype(np.float64)
    return _Cloud(*small_gicp.preprocess_points(points, VOXEL_M, num_neighbors=NEIGHBOURS, num_threads=1))


def _pairs(clouds: list[_Cloud], T: F8) -> list[_Edge]:
    import small_gicp

    edges = []
    for apart in APART:
        for i in range(len(clouds) - apart):
            j = i + apart
            found = small_gicp.align(
                clouds[i].points, clouds[j].points, clouds[i].tree, inverse(T[i]) @ T[j], num_threads=1,
                max_correspondence_distance=REACH_M, rotation_epsilon=2e-5, translation_epsilon=2e-4, max_iterations=30,
            )  # fmt: skip
            left, _, right = np.linalg.svd(found.T_target_source[:3, :3])
            edges.append(_Edge(i, j, pose(left @ right, found.T_target_source[:3, 3])))
    return edges


def _joined(T: F8, edges: list[_Edge]) -> F8:
    """Poses (n, 4, 4) that agree best with all edges, each of the same weight, wrong ones of less."""
    import gtsam

    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([STD_RAD] * 3 + [STD_M] * 3))
    robust = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, start in enumerate(T):
        values.insert(i, gtsam.Pose3(start))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T[0]), noise))
    for edge in edges:
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.T_i_j), robust))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.array([result.atPose3(i).matrix() for i in range(len(T))])


def kept(recording: Recording, T: F8, folder: Path) -> Truth:
    """`refine`, or what it found before on the same recording."""
    path = folder / f"{recording.name}_reference_{recording.digest}.parquet"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        refine(recording, T).write(path)
    return Truth.open(path)
