"""All tracks of one segment of odometry, scan by scan."""

from __future__ import annotations

import dataclasses
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.objects import filter as kalman
from scanloom.stages.objects.association import NOBODY, in_tracks, spread_over_clusters
from scanloom.stages.objects.clusters import clusters, extents, grouped
from scanloom.stages.objects.evidence import Reference, arrived, asked, sampled, without_background
from scanloom.stages.objects.merging import merged
from scanloom.stages.objects.proof import STRETCH, proven
from scanloom.stages.objects.settings import Settings
from scanloom.stages.objects.virtual_scan import VirtualScan

F4 = NDArray[np.float32]
I4 = NDArray[np.int32]

REFERENCE_S = 0.5
AGES_S = (0.5, 1.5, 4.0)
MOVED_M = 0.6
"""Free space is asked of tracks that moved by this between two scans."""
YOUNG = 3.0
YOUNG_REACH_M = 2.5
LOST_REACH_M = 0.6
SAME_SIZE = 2.0
LEAST_TRACK_POINTS = 3
LOWEST_TOP_M = 0.5
SEED_EVERY = 3
"""Every third scan is searched for what arrived beside something larger."""
SEED_RANGE_M = 30.0
SEED_POINTS = 8
SEED_M_S, SEED_WIDTH_M, SEED_WITHIN_M2 = 0.7, 2.8, 4.0
"""What arrived in the box of something that moves, or that is no larger, is not something new."""


@dataclass
class History:
    """What was seen of one track."""

    rows: list[F8] = field(default_factory=list)
    """(kalman.STATE + kalman.SEEN,) of each update."""
    scans: list[int] = field(default_factory=list)
    asked: list[tuple[int, int, int]] = field(default_factory=list)
    """Of each update: how many places were seen to be empty that it had left or came to, how many were not, and how many
    points there were to ask about."""


class Tracker:
    """Tracks of everything that may be an object; those that ended are handed out."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._state = np.empty((0, kalman.STATE))
        self._ids: list[int] = []
        self._next = 0
        self._histories: dict[int, History] = {}
        self._references: deque[Reference] = deque(maxlen=round(AGES_S[-1] / REFERENCE_S) + 1)
        self._last_ns: int | None = None

    def step(self, scan: VirtualScan, stamp_ns: int, scan_index: int, step_rad: float) -> list[History]:
        """Take in one scan; returns the tracks that ended."""
        if self._last_ns is not None:
            kalman.predict(self._state, (stamp_ns - self._last_ns) * 1e-9)
        self._last_ns = stamp_ns
        owner, label, count = self._owners(scan)
        self._hold_to_size(scan, stamp_ns, owner)
        starts, order = grouped(owner, len(self._state))
        seen = update_all(scan.band, starts, order, self._state, scan.origin, scan.ground, scan.starts, scan.returns, step_rad)  # fmt: skip
        self._remember(seen, scan_index)
        self._ask(scan, stamp_ns, seen, starts, order)
        self._prove(seen)
        self._keep_reference(scan, stamp_ns, starts, order)
        self._begin(scan, owner, label, count, scan_index, step_rad)
        if scan_index % SEED_EVERY == 0:
            self._begin_within(scan, stamp_ns, owner, scan_index, step_rad)
        self._merge()
        return self._ended()

    def finish(self) -> list[History]:
        """The tracks that have not ended."""
        return list(self._histories.values())

    def _owners(self, scan: VirtualScan) -> tuple[I4, I4, int]:
        """Track of each point of the band, its cluster, and how many clusters there are."""
        far = self._settings.max_range_m
        label, count = clusters(scan.band, self._settings.link_m, far)
        inside = in_tracks(scan.band, self._state, scan.origin, far)
        owner, of_cluster = spread_over_clusters(inside, label, count, scan.band, self._state, scan.origin, self._settings.longest_m)  # fmt: skip
        shape = extents(scan.band, label, count)
        free = of_cluster == NOBODY
        match_free(self._state, owner, of_cluster, shape, scan.origin, self._settings.longest_m)
        matched = (free & (of_cluster >= 0))[label]
        owner[matched] = of_cluster[label[matched]]
        return owner, label, count

    def _remember(self, seen: F8, scan_index: int) -> None:
        for m in np.flatnonzero(seen[:, kalman.POINTS] > 0):
            history = self._histories[self._ids[m]]
            history.rows.append(np.concatenate((self._state[m], seen[m])))
            history.scans.append(scan_index)
            history.asked.append((0, 0, 0))

    def _ask(self, scan: VirtualScan, stamp_ns: int, seen: F8, starts: I4, order: I4) -> None:
        """Hold the present scan and earlier ones against each other, for tracks that moved between them."""
        for age in AGES_S:
            reference = self._of_age(stamp_ns, age)
            if reference is None:
                continue
            boxes = self._boxes()
            rows = [
                (m, reference.number[i]) for m, i in enumerate(self._ids)
                if i in reference.number and seen[m, kalman.POINTS] > 0
            ]  # fmt: skip
            for m, r in rows:
                if np.hypot(*(boxes[m, :2] - reference.boxes[r, :2])) < MOVED_M:
                    continue
                self._ask_one(scan, reference, m, r, boxes[m], starts, order)

    def _ask_one(self, scan: VirtualScan, reference: Reference, m: int, r: int, box: F8, starts: I4, order: I4) -> None:  # fmt: skip
        _, now = sampled(scan.band, starts[m : m + 2], order, scan.origin)
        before = reference.points[reference.starts[r] : reference.starts[r + 1]]
        a = asked(before, box, scan.origin, scan.starts, scan.returns)
        b = asked(
            now, reference.boxes[r], reference.scan.origin, reference.scan.starts, reference.scan.returns
        )
        asked_here = self._histories[self._ids[m]].asked
        through, taken, points = asked_here[-1]
        asked_here[-1] = (through + a[0] + b[0], taken + a[1] + b[1], points + len(before) + len(now))

    def _prove(self, seen: F8) -> None:
        """Mark the tracks of which it is now proven that they drove."""
        for m in np.flatnonzero((seen[:, kalman.POINTS] > 0) & (self._state[:, kalman.PROVEN] == 0.0)):
            history = self._histories[self._ids[m]]
            if history.asked[-1][0] > 0:
                rows, asked_there = history.rows[-STRETCH:], history.asked[-STRETCH:]
                self._state[m, kalman.PROVEN] = proven(np.array(rows), np.array(asked_there))

    def _of_age(self, stamp_ns: int, age_s: float) -> Reference | None:
        """The kept scan of about that age."""
        for reference in self._references:
            if abs((stamp_ns - reference.stamp_ns) * 1e-9 - age_s) <= 0.5 * REFERENCE_S:
                return reference
        return None

    def _boxes(self) -> F8:
        return np.ascontiguousarray(
            self._state[:, [kalman.X, kalman.Y, kalman.YAW, kalman.LENGTH, kalman.WIDTH]]
        )

    def _keep_reference(self, scan: VirtualScan, stamp_ns: int, starts: I4, order: I4) -> None:
        if self._references and (stamp_ns - self._references[-1].stamp_ns) * 1e-9 < REFERENCE_S - 0.01:
            return
        first, points = sampled(scan.band, starts, order, scan.origin)
        number = {i: m for m, i in enumerate(self._ids) if starts[m + 1] > starts[m]}
        self._references.append(Reference(stamp_ns, scan, number, self._boxes(), first, points))

    def _begin(
        self, scan: VirtualScan, owner: I4, label: I4, count: int, scan_index: int, step_rad: float
    ) -> None:
        """New tracks from clusters that nobody has."""
        free = np.where(owner == NOBODY, label, NOBODY).astype(np.int32)
        partly = np.zeros(count, bool)
        partly[label[owner != NOBODY]] = True
        shape = extents(scan.band, free, count)
        s = self._settings
        broad = np.hypot(shape[:, 3] - shape[:, 1], shape[:, 4] - shape[:, 2])
        wanted = (
            (shape[:, 0] >= s.min_points) & (broad <= s.longest_m) & (shape[:, 5] >= LOWEST_TOP_M) & ~partly
        )
        self._start(scan, free, count, wanted, scan_index, step_rad)

    def _begin_within(
        self, scan: VirtualScan, stamp_ns: int, owner: I4, scan_index: int, step_rad: float
    ) -> None:
        """New tracks from what arrived beside something larger, a wall or a hedge, since an earlier scan."""
        reference = self._of_age(stamp_ns, AGES_S[1]) or self._of_age(stamp_ns, AGES_S[0])
        if reference is None:
            return
        then = reference.scan
        moving = np.hypot(self._state[:, kalman.VX], self._state[:, kalman.VY]) > SEED_M_S
        moving |= self._state[:, kalman.PROVEN] > 0.0
        moving &= np.minimum(self._state[:, kalman.LENGTH], self._state[:, kalman.WIDTH]) < SEED_WIDTH_M
        small = self._state[:, kalman.LENGTH] * self._state[:, kalman.WIDTH] < SEED_WITHIN_M2
        inside = in_tracks(
            scan.band,
            np.ascontiguousarray(self._state[moving | small]),
            scan.origin,
            self._settings.max_range_m,
        )
        owned = np.append(moving | small, False)[owner]
        taken = owned | (inside != NOBODY)
        near = np.hypot(scan.band[:, 0], scan.band[:, 1]) < SEED_RANGE_M
        new = arrived(scan.band, near & ~taken, scan.origin, then.origin, then.starts, then.returns)
        band = np.ascontiguousarray(scan.band[new])
        label, count = clusters(band, self._settings.link_m, self._settings.max_range_m)
        shape = extents(band, label, count)
        broad = np.hypot(shape[:, 3] - shape[:, 1], shape[:, 4] - shape[:, 2])
        wanted = (shape[:, 0] >= SEED_POINTS) & (broad <= self._settings.longest_m) & (shape[:, 5] >= LOWEST_TOP_M)  # fmt: skip
        self._start(dataclasses.replace(scan, band=band), label, count, wanted, scan_index, step_rad)

    def _start(
        self, scan: VirtualScan, label: I4, count: int, wanted: NDArray[np.bool_], scan_index: int, step_rad: float
    ) -> None:  # fmt: skip
        """New tracks from the wanted ones of `count` clusters."""
        starts, order = grouped(label, count)
        fresh, seen = new_states(
            scan.band, starts, order, np.flatnonzero(wanted), scan.origin, scan.ground, scan.starts, scan.returns, step_rad
        )  # fmt: skip
        slim = np.minimum(fresh[:, kalman.LENGTH], fresh[:, kalman.WIDTH]) <= self._settings.widest_m
        for row in np.column_stack((fresh, seen))[slim]:
            self._ids.append(self._next)
            self._histories[self._next] = History([row], [scan_index], [(0, 0, 0)])
            self._next += 1
        self._state = np.concatenate((self._state, fresh[slim]))

    def _hold_to_size(self, scan: VirtualScan, stamp_ns: int, owner: I4) -> None:
        """Tracks do not grow into what stood there before them."""
        reference = self._of_age(stamp_ns, AGES_S[0])
        if reference is None:
            return
        then = reference.scan
        row_then = np.array([reference.number.get(i, -1) for i in self._ids], np.int32)
        without_background(
            owner, scan.band, scan.origin, self._state, row_then, reference.boxes, then.origin, then.starts, then.returns,
            self._settings.longest_m,
        )  # fmt: skip

    def _merge(self) -> None:
        """Parts of one thing that were taken for several become one track, the oldest of them."""
        remain = merged(self._state, self._settings.longest_m, self._settings.widest_m)
        if not remain.all():
            for m in np.flatnonzero(~remain):
                del self._histories[self._ids[m]]
            self._keep(remain)

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        self._ids = [self._ids[m] for m in np.flatnonzero(kept)]
        self._state = np.ascontiguousarray(self._state[kept])

    def _ended(self) -> list[History]:
        """Take out the tracks that are lost, or have become something that is no object."""
        s = self._settings
        state = self._state
        lost = state[:, kalman.MISSED_S] > np.where(state[:, kalman.HITS] < YOUNG, 0.25, s.lost_s)
        large = (state[:, kalman.LENGTH] > s.longest_m) | (state[:, kalman.WIDTH] > s.longest_m)
        large |= np.minimum(state[:, kalman.LENGTH], state[:, kalman.WIDTH]) > s.widest_m
        kept = ~(lost | large)
        gone = [self._histories.pop(self._ids[m]) for m in np.flatnonzero(~kept)]
        self._keep(kept)
        return gone


@kernel
def match_free(state: F8, owner: I4, of_cluster: I4, shape: F8, origin: F8, longest: float) -> None:
    """Tracks without a point take the nearest free cluster of like size within reach, in place of NOBODY."""
    has = np.zeros(len(state), np.bool_)
    for n in range(len(owner)):
        if owner[n] >= 0:
            has[owner[n]] = True
    for m in range(len(state)):
        if has[m]:
            continue
        reach = YOUNG_REACH_M if state[m, kalman.HITS] < YOUNG else LOST_REACH_M
        best, found = reach, -1
        for c in range(len(shape)):
            if of_cluster[c] != NOBODY or shape[c, 0] < LEAST_TRACK_POINTS:
                continue
            size = np.hypot(shape[c, 3] - shape[c, 1], shape[c, 4] - shape[c, 2])
            own = np.hypot(state[m, kalman.LENGTH], state[m, kalman.WIDTH])
            if size > min(own + SAME_SIZE, longest):
                continue
            dx = max(max(shape[c, 1] + origin[0] - state[m, 0], state[m, 0] - shape[c, 3] - origin[0]), 0.0)
            dy = max(max(shape[c, 2] + origin[1] - state[m, 1], state[m, 1] - shape[c, 4] - origin[1]), 0.0)
            off = max(np.hypot(dx, dy) - 0.25 * own, 0.0)
            if off < best:
                best, found = off, c
        if found >= 0:
            of_cluster[found] = m


@kernel
def update_all(band: F4, starts: I4, order: I4, state: F8, origin: F8, ground: F4, bins: I4, returns: F4, step_rad: float) -> F8:  # fmt: skip
    """Update every track by its points; what was seen of it (m, SEEN), zero where too little was."""
    seen = np.zeros((len(state), kalman.SEEN))
    for m in range(len(state)):
        if starts[m + 1] - starts[m] >= LEAST_TRACK_POINTS:
            points = np.ascontiguousarray(band[order[starts[m] : starts[m + 1]]])
            kalman.update(points, origin, ground, bins, returns, step_rad, state[m], seen[m])
    return seen


@kernel
def new_states(
    band: F4, starts: I4, order: I4, wanted: NDArray[np.int64], origin: F8, ground: F4, bins: I4, returns: F4, step_rad: float
) -> tuple[F8, F8]:  # fmt: skip
    """States of new tracks, one for each of the wanted groups, and what was seen of them."""
    state, seen = np.zeros((len(wanted), kalman.STATE)), np.zeros((len(wanted), kalman.SEEN))
    for k in range(len(wanted)):
        g = wanted[k]
        points = np.ascontiguousarray(band[order[starts[g] : starts[g + 1]]])
        kalman.start(points, origin, ground, state[k])
        kalman.update(points, origin, ground, bins, returns, step_rad, state[k], seen[k])
    return state, seen
