"""A scan among its neighbours: what lies in the scans shortly before and after it, and how the LiDAR moved between them.

Scans stream through; a few before and a few after the present one are held. The motion comes from gyro and wheels
where they are sound, else from registering each scan with the one before it, which deskew has done as a rule; where that
fails too it is unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, Scan
from scanloom.stages.denoise.frame import Frame
from scanloom.stages.geometry.motion import MotionTrack
from scanloom.stages.geometry.neighbours import TARGET_POINTS, ThinScan, twist_between
from scanloom.stages.geometry.range_image import RangeImage
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp

U1 = NDArray[np.uint8]

LONGEST_PAUSE_NS = 500_000_000
"""Scans farther apart than this are no neighbours."""


@dataclass(frozen=True)
class View:
    """A scan and what a look at it alone tells."""

    scan: DeskewedScan
    classes: U1
    """(n,) values of PointClass; STATIC where nothing else is known."""
    image: RangeImage
    """Of the points in range that are not the own vehicle."""

    @cached_property
    def frame(self) -> Frame:
        """The image, for looking up neighbours."""
        return Frame.of(self.image, self.scan.x_m, self.scan.y_m, self.scan.z_m)


@dataclass(frozen=True)
class Neighbour:
    """A scan near the present one."""

    view: View
    offset: int
    """-2 is two scans before the present one, 1 the one after it."""
    T_scan_neighbour: F8 | None
    """(4, 4) from the neighbour's LiDAR frame to the present one's, each at its own `reference_ns`; None if unknown."""

    @property
    def T_neighbour_scan(self) -> F8 | None:
        return None if self.T_scan_neighbour is None else inverse(self.T_scan_neighbour)


@dataclass(frozen=True)
class Moment:
    """The present scan with the scans around it, by offset; fewer at the ends of a chunk and around pauses."""

    view: View
    neighbours: tuple[Neighbour, ...]

    def known(self, *offsets: int) -> list[tuple[View, F8]]:
        """The neighbours with known motion, as (view, T_scan_neighbour); only those at the `offsets` if any are given."""
        return [
            (each.view, each.T_scan_neighbour)
            for each in self.neighbours
            if each.T_scan_neighbour is not None and (not offsets or each.offset in offsets)
        ]


def moments(
    views: Iterable[View], track: MotionTrack, reach: int, *, register: bool = True
) -> Iterator[Moment]:
    """Each scan with up to `reach` neighbours before and after it; at most 2 reach + 1 scans are held.

    register : find the motion by registration where the sensors are silent.
    """
    steps = _Steps(track, register)
    held: list[View] = []
    T_before: list[F8 | None] = []  # of each held scan, to the one before it
    present = 0
    for view in views:
        T_before.append(steps.step(held[-1], view) if held else None)
        held.append(view)
        if len(held) - 1 - present >= reach:
            yield _moment(held, T_before, present, reach)
            present += 1
        if present > reach:
            del held[0], T_before[0]
            present -= 1
    for last in range(present, len(held)):
        yield _moment(held, T_before, last, reach)


def _moment(held: list[View], T_before: list[F8 | None], present: int, reach: int) -> Moment:
    """`T_before[i]` is T_(i-1)_i; the chain breaks where one is unknown."""
    found: list[Neighbour] = []
    T: F8 | None = np.eye(4)
    for k in range(present, max(present - reach, 0), -1):
        step = T_before[k]
        T = None if T is None or step is None else T @ inverse(step)
        found.append(Neighbour(held[k - 1], k - 1 - present, T))
    found.reverse()
    T = np.eye(4)
    for k in range(present + 1, min(present + reach, len(held) - 1) + 1):
        step = T_before[k]
        T = None if T is None or step is None else T @ step
        found.append(Neighbour(held[k], k - present, T))
    return Moment(held[present], tuple(found))


class _Steps:
    """Motion from each scan to the next."""

    def __init__(self, track: MotionTrack, register: bool) -> None:
        self._track, self._register = track, register
        self._thin: ThinScan | None = None
        self._twist: F8 | None = None

    def step(self, before: View, view: View) -> F8 | None:
        """T_before_view (4, 4), or None."""
        a_ns, b_ns = before.scan.reference_ns, view.scan.reference_ns
        if not 0 < b_ns - a_ns < LONGEST_PAUSE_NS:
            self._thin = self._twist = None
            return None
        cover = self._track.covers(a_ns, b_ns)
        if cover.rotation and cover.translation:
            self._thin = self._twist = None
            return self._track.relative(a_ns, b_ns)
        if not self._register:
            return None
        if len(before.scan.next_twist):  # deskew has registered the two
            self._thin, self._twist = None, np.array(before.scan.next_twist, float)
            return se3_exp(self._twist * (b_ns - a_ns) * 1e-9)
        return self._registered(before, view)

    def _registered(self, before: View, view: View) -> F8 | None:
        near = self._thin or ThinScan.of(_standing(before.scan))
        self._thin = ThinScan.of(_standing(view.scan))
        self._twist = twist_between(near, self._thin, self._track, self._twist)
        if self._twist is None:
            return None
        return se3_exp(self._twist * (self._thin.reference_ns - near.reference_ns) * 1e-9)


def _standing(scan: DeskewedScan) -> Scan:
    """The scan as one whose points all were measured at its reference time, as deskewing made it."""
    used = np.flatnonzero(np.isfinite(scan.x_m + scan.y_m + scan.z_m))
    used = used[:: max(1, len(used) // TARGET_POINTS) | 1]  # no more are looked at
    return Scan(
        stamp_ns=np.full(len(used), scan.reference_ns, np.int64),
        x_m=scan.x_m[used], y_m=scan.y_m[used], z_m=scan.z_m[used], intensity=scan.intensity[used],
        ring=np.zeros(len(used), np.uint16), return_no=np.zeros(len(used), np.uint8),
        reference_ns=scan.reference_ns, scan_index=scan.scan_index,
    )  # fmt: skip
