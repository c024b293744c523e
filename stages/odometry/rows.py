"""Rows of the product while a session is tracked: the last ones are provisional as long as the map is lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.degeneracy import Degeneracy
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.odometry.bridging import close_gap


@dataclass(frozen=True)
class Row:
    """What odometry says of one scan; the columns of the product."""

    scan_index: int
    stamp_ns: int
    T_odom_lidar: F8
    covariance: F8
    inlier_ratio: float
    rmse_m: float
    seen: Degeneracy
    keyframe: bool
    reliable: bool
    segment: int = 0


class Rows:
    """Rows in the order of the scans.

    sure : place of the last row that was registered to the map. The motions after it may be guesses.
    """

    def __init__(self) -> None:
        self.rows: list[Row] = []
        self.sure = 0
        self.segment = 0

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def T_sure(self) -> F8:
        return self.rows[self.sure].T_odom_lidar

    @property
    def sure_ns(self) -> int:
        return self.rows[self.sure].stamp_ns

    @property
    def last_ns(self) -> int:
        return self.rows[-1].stamp_ns

    @property
    def lost(self) -> bool:
        """Whether rows wait for a registration."""
        return self.sure < len(self.rows) - 1

    def add(self, row: Row) -> None:
        self.rows.append(dataclasses.replace(row, segment=self.segment))

    def settle(self, T_predicted: F8, covariance_predicted: F8) -> None:
        """The last row was registered to the map: the motions guessed since `sure` are corrected by what was missing."""
        first, last = self.sure, len(self.rows) - 1
        self.sure = last
        if last - first < 2:
            return
        stretch = self.rows[first:]
        T = np.array([*(r.T_odom_lidar for r in stretch[:-1]), T_predicted])
        covariance = np.array([*(r.covariance for r in stretch[1:-1]), covariance_predicted])
        T, covariance = close_gap(T, covariance, stretch[-1].T_odom_lidar, stretch[-1].covariance)
        for k in range(1, len(stretch)):
            self.rows[first + k] = dataclasses.replace(
                stretch[k], T_odom_lidar=T[k], covariance=covariance[k - 1]
            )

    def withdraw(self, covariance: F8) -> None:
        """The last row was registered to the wrong place: its motion counts as guessed, with this covariance."""
        self.rows[-1] = dataclasses.replace(self.rows[-1], reliable=False, covariance=covariance)
        self.sure = len(self.rows) - 2

    def split(self, first: int, covariance: F8) -> None:
        """A new segment begins at row `first`: nothing tells the motion to it from the row before.

        The rows on either side become keyframes, so that the unknown motion is one factor of its own in the pose graph.
        """
        self.segment += 1
        self.sure = len(self.rows) - 1
        self.rows[first - 1] = dataclasses.replace(self.rows[first - 1], keyframe=True)
        for k in range(first, len(self.rows)):
            self.rows[k] = dataclasses.replace(self.rows[k], segment=self.segment)
        self.rows[first] = dataclasses.replace(
            self.rows[first], keyframe=True, reliable=False, covariance=covariance
        )

    def table(self) -> Odometry:
        """The product."""
        return table(self.rows)


def table(rows: Sequence[Row]) -> Odometry:
    """The product of these rows."""
    return Odometry(
        scan_index=np.array([r.scan_index for r in rows], np.int64),
        stamp_ns=np.array([r.stamp_ns for r in rows], np.int64),
        T_odom_lidar=np.array([r.T_odom_lidar for r in rows]),
        covariance=np.array([r.covariance for r in rows]),
        inlier_ratio=np.array([r.inlier_ratio for r in rows]),
        rmse_m=np.array([r.rmse_m for r in rows]),
        degeneracy_d=np.array([r.seen.d for r in rows]),
        degeneracy_e=np.array([r.seen.e_m for r in rows]),
        direction_p=np.array([r.seen.p for r in rows]),
        weak_directions=np.array([r.seen.directions for r in rows]),
        keyframe=np.array([r.keyframe for r in rows]),
        reliable=np.array([r.reliable for r in rows]),
        segment=np.array([r.segment for r in rows], np.int32),
    )
