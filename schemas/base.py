"""The base of an extension: where the scans of a finished map stand in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Files, Table, attribute, column
from scanloom.schemas.trajectory import Poses


@dataclass(frozen=True)
class BaseLog(Files):
    """The trajectory of a session in the map that is extended. Empty for a session that is new."""

    NAME: ClassVar[str] = "base_log"


@dataclass(frozen=True)
class Base(Table):
    """One row per scan of a session that the map to be extended holds: its pose there. No rows for a new session."""

    NAME: ClassVar[str] = "base"

    scan_index: NDArray[np.int64] = column("i8", "number of the scan in its session")
    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    T_world_lidar: NDArray[np.float64] = column(
        "f8", "pose of the LiDAR", unit="m", shape=(4, 4), frame="world or map"
    )
    covariance: NDArray[np.float64] = column(
        "f8", "marginal covariance, order (rotation, translation), right tangent", shape=(6, 6), frame="lidar"
    )
    keyframe: NDArray[np.bool_] = column("?", "pose was a node of the pose graph; others were interpolated")
    frame: str = attribute("`world` when georeferenced, else `map`; empty for a new session")
    georeference: dict[str, Any] | None = attribute("fields of `frames.Georeference`, or null")

    @classmethod
    def of(cls, poses: Poses) -> Base:
        """The base that a finished session's poses are."""
        return cls(
            poses.scan_index, poses.stamp_ns, poses.T_world_lidar, poses.covariance, poses.keyframe,
            poses.frame, poses.georeference,
        )  # fmt: skip

    def poses(self) -> Poses:
        """The poses it was made of, exactly."""
        return Poses(
            self.scan_index, self.stamp_ns, self.T_world_lidar, self.covariance, self.keyframe,
            self.frame, self.georeference,
        )  # fmt: skip
