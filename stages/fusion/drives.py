"""One session's inputs to the fusion, with what is asked of them again and again.

Where odometry lost the motion a new drive begins: nothing but loops, GNSS and the vehicle's own sensors tells where it
stands to the one before, so that each is placed like a session of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Parts, ProductT
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.rig import corrected
from scanloom.stages.geometry.se3 import F8, adjoint, inverse
from scanloom.stages.geometry.unseen import SEEN_P

I8 = NDArray[np.int64]

UNKNOWN_STEP_SIGMA = (np.radians(5.0), 1.0)
"""Rotation rad, translation m assumed for a step whose covariance odometry does not know."""


@dataclass(frozen=True)
class Drive:
    """A segment of a session on its way through the fusion; `first_node` numbers its first keyframe among all drives'.

    Odometry and GNSS are those of the segment; IMU and wheels, on the LiDAR's clock, those of the whole session.
    """

    name: str
    """Of the session."""
    session: Session
    odometry: Odometry
    gnss: Gnss
    imu: Imu
    wheel: Wheel
    first_node: int
    keyframes: I8
    """Rows of `odometry` that are nodes of the graph."""

    @property
    def segment(self) -> int:
        """Number of the segment in its session."""
        return int(self.odometry.segment[0])

    @property
    def title(self) -> str:
        """How messages call it."""
        return self.name if self.segment == 0 else f"{self.name}, segment {self.segment}"

    @property
    def nodes(self) -> I8:
        return self.first_node + np.arange(len(self.keyframes))

    @cached_property
    def travelled_m(self) -> F8:
        """Path length (n,) from the first scan to each scan."""
        step = np.linalg.norm(np.diff(self.odometry.T_odom_lidar[:, :3, 3], axis=0), axis=1)
        return np.concatenate(([0.0], np.cumsum(step)))

    @cached_property
    def T_base_lidar(self) -> F8:
        return np.array(self.session.T_base("lidar"))

    @cached_property
    def T_lidar_imu(self) -> F8:
        return np.asarray(inverse(self.T_base_lidar) @ np.array(self.session.T_base("imu")))

    @cached_property
    def antenna_m(self) -> F8:
        """GNSS antenna (3,) in the LiDAR frame."""
        T = inverse(self.T_base_lidar) @ np.array(self.session.T_base("gnss"))
        return np.asarray(T[:3, 3])

    def T_odom_lidar_at(self, stamp_ns: I8) -> F8:
        return interpolate_poses(self.odometry.stamp_ns, self.odometry.T_odom_lidar, stamp_ns)

    def travelled_at(self, stamp_ns: I8) -> F8:
        start = self.odometry.stamp_ns[0]
        at, known = (stamp_ns - start).astype(float), (self.odometry.stamp_ns - start).astype(float)
        return np.asarray(np.interp(at, known, self.travelled_m))

    def nearest_keyframe(self, stamp_ns: I8) -> I8:
        """Place in `keyframes` of the one nearest in time to each stamp."""
        stamps = self.odometry.stamp_ns[self.keyframes]
        after = np.clip(np.searchsorted(stamps, stamp_ns), 1, max(len(stamps) - 1, 1))
        if len(stamps) == 1:
            return np.zeros(len(stamp_ns), np.int64)
        earlier = stamp_ns - stamps[after - 1] <= stamps[after] - stamp_ns
        return np.where(earlier, after - 1, after).astype(np.int64)

    def key(self, keyframe: int) -> str:
        return f"{self.name}/{self.odometry.scan_index[self.keyframes[keyframe]]}"

    def keyframe_of_scan(self, scan_index: int) -> int:
        """Place in `keyframes` of a scan.

        Raises
        ------
        StageError : a loop names a scan that is no keyframe of this session.
        """
        indices = self.odometry.scan_index[self.keyframes]
        at = int(np.searchsorted(indices, scan_index))
        if at == len(indices) or indices[at] != scan_index:
            raise StageError(
                f"a loop names scan {scan_index}, which odometry does not hold as a keyframe",
                where=f"session {self.name}",
                next_step="run the loops stage again on this odometry",
            )
        return at

    def keyframe_motions(
        self, rotation_rad_sqrt_m: float, translation_m_sqrt_m: float, step_covariance: F8
    ) -> tuple[F8, F8]:
        """Motions (k-1, 4, 4) between neighbouring keyframes and their covariances (k-1, 6, 6).

        Covariances of the single steps (n, 6, 6) are carried to the end of the motion, C = sum Ad(T_b^-1 T_k) C_k Ad^T,
        and a random walk in the distance driven is added: steps share errors that their own covariances do not tell.
        """
        T, rows = self.odometry.T_odom_lidar, self.keyframes
        motion = inverse(T[rows[:-1]]) @ T[rows[1:]]
        steps = np.arange(rows[0] + 1, rows[-1] + 1)
        if not len(steps):
            return motion, np.zeros((0, 6, 6))
        end = rows[np.searchsorted(rows, steps)]
        A = adjoint(inverse(T[end]) @ T[steps])
        carried = A @ step_covariance[steps] @ np.swapaxes(A, 1, 2)
        covariance = np.add.reduceat(carried, rows[:-1] - rows[0], axis=0)
        path = np.diff(self.travelled_m[rows])
        walk = np.repeat([rotation_rad_sqrt_m**2, translation_m_sqrt_m**2], 3)
        still = np.repeat([np.radians(0.01) ** 2, 0.002**2], 3)
        covariance = covariance + (path[:, None] * walk + still)[:, :, None] * np.eye(6)
        return motion, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))

    def step_covariance(self) -> F8:
        """Covariances (n, 6, 6) of the motion to each scan as odometry states them; a wide guess where it does not."""
        return trusted(self.odometry.covariance)

    def unseen(self) -> F8:
        """(n, 6, 6): sum of u u^T over the directions u that a scan did not see, rotation and translation apart.

        Odometry's directions are those of the scaled tangent, where both parts are metres.
        """
        u = self.odometry.weak_directions * (self.odometry.direction_p < SEEN_P)[:, None, :]
        out = u @ np.swapaxes(u, 1, 2)
        out[:, :3, 3:] = out[:, 3:, :3] = 0.0
        return np.asarray(out)


def trusted(covariance: F8) -> F8:
    """Covariances with the unknown ones (not finite, or negative on the diagonal) replaced by a wide guess."""
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    good = np.asarray(np.isfinite(covariance).all(axis=(1, 2)) & (diagonal >= 0).all(axis=1))
    wide = np.diag(np.repeat(UNKNOWN_STEP_SIGMA, 3) ** 2)
    return np.where(good[:, None, None], covariance, wide)


def gather(
    session: Parts[Session],
    odometry: Parts[Odometry],
    gnss: Parts[Gnss],
    imu: Parts[Imu],
    wheel: Parts[Wheel] | None = None,
    check: Parts[SensorCheck] | None = None,
) -> Iterator[Drive]:
    """The sessions of a map in order of their names, segment by segment; IMU and wheels are corrected as `check` says.

    Raises
    ------
    StageError : a session has no odometry.
    """
    tracks, fixes, inertial = _by_session(odometry), _by_session(gnss), _by_session(imu)
    turning, checks = _by_session(wheel), _by_session(check)
    first_node = 0
    for name, document in sorted(_by_session(session).items()):
        track = tracks.get(name)
        if track is None or len(track) == 0:
            raise StageError(
                "odometry has no pose to fuse",
                where=f"session {name}",
                next_step="look why odometry gave no scan a pose",
            )
        sensors = corrected(
            inertial.get(name, Imu.empty()), turning.get(name, Wheel.empty()), checks.get(name)
        )
        for part, own in _segments(track, fixes.get(name, Gnss.empty())):
            keyframes = np.flatnonzero(part.keyframe).astype(np.int64)
            if not len(keyframes):
                keyframes = np.unique([0, len(part) - 1]).astype(np.int64)
            yield Drive(name, document, part, own, *sensors, first_node, keyframes)
            first_node += len(keyframes)


def _segments(track: Odometry, gnss: Gnss) -> Iterator[tuple[Odometry, Gnss]]:
    """Odometry of each segment with the fixes from its first scan to that of the next one."""
    first = np.unique(track.segment, return_index=True)[1]
    if len(first) == 1:
        yield track, gnss
        return
    number = np.searchsorted(track.stamp_ns[first], gnss.stamp_ns, side="right") - 1
    for k, rows in enumerate(np.split(np.arange(len(track)), np.sort(first)[1:])):
        yield track.take(rows), gnss.take(np.flatnonzero(np.maximum(number, 0) == k))


def _by_session(parts: Parts[ProductT] | None) -> dict[str, ProductT]:
    if parts is None:
        return {}
    return {where.get("session", ""): part for where, part in parts.items()}
