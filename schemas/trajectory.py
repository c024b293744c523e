"""Poses over time: odometry, optimised poses, truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Table, attribute, column


@dataclass(frozen=True)
class Odometry(Table):
    """One row per scan: where the LiDAR was, from scans alone and what moves them; frame `odom` starts at the first scan."""

    NAME: ClassVar[str] = "odometry"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session")
    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    T_odom_lidar: NDArray[np.float64] = column(
        "f8", "pose of the LiDAR", unit="m", shape=(4, 4), frame="odom"
    )
    covariance: NDArray[np.float64] = column(
        "f8",
        "covariance of the motion since the previous scan, order (rotation, translation), right tangent",
        unit="rad2, m2",
        shape=(6, 6),
        frame="lidar",
    )
    inlier_ratio: NDArray[np.float64] = column(
        "f8", "share of the used points that found a partner in the local map"
    )
    rmse_m: NDArray[np.float64] = column("f8", "root mean square of the point-to-plane residuals", unit="m")
    degeneracy_d: NDArray[np.float64] = column(
        "f8", "D: smallest eigenvalue of the translation information, per point"
    )
    degeneracy_e: NDArray[np.float64] = column(
        "f8", "E1: residual-scaled worst standard deviation of translation", unit="m"
    )
    direction_p: NDArray[np.float64] = column(
        "f8", "probability that each eigen-direction is observed beyond noise", shape=(6,)
    )
    weak_directions: NDArray[np.float64] = column(
        "f8", "eigenvectors of the information as columns, weakest first", shape=(6, 6), frame="lidar"
    )
    keyframe: NDArray[np.bool_] = column("?", "scan is part of the local map and of the pose graph")
    reliable: NDArray[np.bool_] = column(
        "?", "registration converged; false where motion was bridged by prediction"
    )
    segment: NDArray[np.int32] = column(
        "i4",
        "number of the segment, from 0; nothing tells the motion from the last scan of one to the first of the next",
    )


@dataclass(frozen=True)
class Poses(Table):
    """One row per scan of a session: the optimised pose in the map. One part per session."""

    NAME: ClassVar[str] = "poses"
    SPLIT_BY: ClassVar[str] = "session"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session")
    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    T_world_lidar: NDArray[np.float64] = column(
        "f8", "pose of the LiDAR", unit="m", shape=(4, 4), frame="world or map"
    )
    covariance: NDArray[np.float64] = column(
        "f8", "marginal covariance, order (rotation, translation), right tangent", shape=(6, 6), frame="lidar"
    )
    keyframe: NDArray[np.bool_] = column("?", "pose is a node of the pose graph; others are interpolated")
    frame: str = attribute("`world` when georeferenced, else `map`")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")


@dataclass(frozen=True)
class Truth(Table):
    """The true trajectory of the LiDAR, for evaluation only. No rows when there is none."""

    NAME: ClassVar[str] = "truth"

    stamp_ns: NDArray[np.int64] = column("i8", "time of the pose, on the LiDAR's clock", unit="ns")
    T_truth_lidar: NDArray[np.float64] = column(
        "f8", "pose of the LiDAR", unit="m", shape=(4, 4), frame="truth"
    )
    source: str = attribute("where the truth comes from and how far to trust it, in words")
    georeference: dict[str, Any] | None = attribute(
        "fields of `frames.Georeference` where the frame `truth` is east, north, up at a known place, else null",
        default=None,
    )
