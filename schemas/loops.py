"""Places seen again: descriptors of places, loop candidates and what became of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Table, attribute, column


@dataclass(frozen=True)
class Places(Table):
    """One row per keyframe: what it looks like. Heights are those of the highest point per ring and sector, row by row.

    The ones from beside have the middle of the rings a lane to the left and a lane to the right of the LiDAR.
    """

    NAME: ClassVar[str] = "places"
    SCHEMA_VERSION: ClassVar[int] = 2

    scan_index: NDArray[np.int64] = column("i8", "number of the keyframe's scan in its session")
    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    descriptor: NDArray[np.float32] = column("f4", "scan context", unit="m", shape=(20, 60))
    beside: NDArray[np.float32] = column("f4", "the same from beside", unit="m", shape=(2, 20, 60))
    segment_descriptor: NDArray[np.float32] = column(
        "f4",
        "scan context of segments alone: without ground and what is no structure",
        unit="m",
        shape=(20, 60),
    )
    segment_beside: NDArray[np.float32] = column("f4", "the same from beside", unit="m", shape=(2, 20, 60))
    max_radius_m: float = attribute("radius of the outermost ring, m")
    lane_m: float = attribute("how far beside the LiDAR the middle of the rings is, m")


@dataclass(frozen=True)
class Loops(Table):
    """One row per candidate, accepted or not. Scan i is the earlier one."""

    NAME: ClassVar[str] = "loops"

    session_i: NDArray[np.object_] = column("str", "session of scan i")
    scan_i: NDArray[np.int64] = column("i8", "number of scan i in its session")
    session_j: NDArray[np.object_] = column("str", "session of scan j")
    scan_j: NDArray[np.int64] = column("i8", "number of scan j in its session")
    T_i_j: NDArray[np.float64] = column(
        "f8", "pose of LiDAR j in LiDAR i from geometric verification", unit="m", shape=(4, 4)
    )
    covariance: NDArray[np.float64] = column(
        "f8", "of T_i_j, order (rotation, translation), right tangent", shape=(6, 6)
    )
    source: NDArray[np.object_] = column(
        "str",
        "what proposed it: `position`; `temporal`, alike with the places before and after; `segments`, alike in what is left "
        "of the scans without ground and leaves",
    )
    descriptor_distance: NDArray[np.float64] = column(
        "f8", "scan context distance, 0 same to 1 different; NaN for candidates by position"
    )
    temporal_distance: NDArray[np.float64] = column(
        "f8", "mean scan context distance of the places before and after; NaN for candidates by position"
    )
    segment_distance: NDArray[np.float64] = column(
        "f8", "segment scan context distance; NaN where it was not asked"
    )
    inlier_ratio: NDArray[np.float64] = column("f8", "share of points of submap j with a partner in submap i")
    rmse_m: NDArray[np.float64] = column("f8", "root mean square residual of the inliers", unit="m")
    overlap: NDArray[np.float64] = column("f8", "share of voxels of submap j that submap i also fills")
    seen_through: NDArray[np.float64] = column(
        "f8", "share of tall structure of one pass that the other looked through: free-space conflict"
    )
    e1_m: NDArray[np.float64] = column(
        "f8", "E1 of the registration: residual-scaled worst standard deviation of translation", unit="m"
    )
    rival: NDArray[np.float64] = column(
        "f8", "fit of the second-best pose over that of the best; 0 when there is none"
    )
    accepted: NDArray[np.bool_] = column(
        "?", "passed the geometric tests and enters the pose graph, which may still doubt it"
    )
    reason: NDArray[np.object_] = column("str", "why it was accepted or rejected, in words")
