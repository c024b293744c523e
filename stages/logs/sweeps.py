"""Scans from decoded clouds: points without return dropped, every point timed, in order; and what had to be dropped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.scans import Scan
from scanloom.schemas.session import Problem, Severity
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.pointcloud import (
    azimuth_times,
    correct_vertical_angle,
    decode_livox,
    decode_pointcloud2,
)
from scanloom.stages.logs.records import Cloud, CloudFile, LivoxCloud, LogSource, PointCloud2

CloudMessage = PointCloud2 | LivoxCloud | CloudFile
PointTime = Literal["per point", "from azimuth", "none"]
_REORDER_DEPTH = 3
_LONGEST_SWEEPS = 3.0
"""Points of one scan spread over more periods than this have times that mean something else."""
_FEW_POINTS = 300
_FARTHEST_M = np.float32(20_000)


@dataclass
class ScanTally:
    """What is counted while scans are made."""

    scans: int = 0
    points: int = 0
    no_return: int = 0
    first_ns: int = 0
    last_ns: int = 0
    beams: int = 0
    point_time: PointTime = "none"
    problems: list[Problem] = field(default_factory=list)


class ScanMaker:
    """Turns decoded clouds into scans in order of time, and counts what it drops."""

    def __init__(self, settings: Settings, topic: str, period_ns: int) -> None:
        self.settings, self.topic, self.period_ns = settings, topic, period_ns
        self.tally = ScanTally()
        self._kinds: Counter[PointTime] = Counter()
        self._remarks: Counter[str] = Counter()
        self._damaged: list[str] = []
        self._late = self._empty = self._flat_times = self._wide_times = 0

    def ordered(self, clouds: Iterator[CloudMessage]) -> Iterator[Scan]:
        """Scans by increasing reference time; slightly swapped ones are put right, later ones dropped."""
        waiting: list[Scan] = []
        last_ns: int | None = None
        for scan in chain(self._scans(clouds), [None] * _REORDER_DEPTH):
            if scan is not None:
                waiting.append(scan)
                waiting.sort(key=lambda s: s.reference_ns)
            if not waiting or (scan is not None and len(waiting) < _REORDER_DEPTH):
                continue
            earliest = waiting.pop(0)
            if last_ns is not None and earliest.reference_ns <= last_ns:
                self._late += 1
                continue
            last_ns = earliest.reference_ns
            yield self._counted(earliest)

    def _scans(self, clouds: Iterator[CloudMessage]) -> Iterator[Scan]:
        for message in clouds:
            try:
                cloud = _decode(message)
            except InvalidInput as error:
                self._damaged.append(error.what)
                continue
            self._remarks.update([cloud.remark] if cloud.remark else [])
            scan = self._scan(cloud)
            if scan is None:
                self._empty += 1
            else:
                yield scan

    def _scan(self, cloud: Cloud) -> Scan | None:
        if self.settings.vertical_correction_deg:
            cloud = correct_vertical_angle(cloud, np.radians(self.settings.vertical_correction_deg))
        keep = _returns(cloud)
        kept = int(np.count_nonzero(keep))
        self.tally.no_return += len(keep) - kept
        if not kept:
            return None
        if kept < len(keep):
            cloud = _rows(cloud, np.flatnonzero(keep))
        stamp_ns, reference_ns, kind = self._times(cloud)
        self._kinds[kind] += 1
        return Scan(
            stamp_ns=stamp_ns,
            x_m=cloud.x_m,
            y_m=cloud.y_m,
            z_m=cloud.z_m,
            intensity=cloud.intensity,
            ring=cloud.ring,
            return_no=cloud.return_no,
            reference_ns=reference_ns,
            scan_index=0,
        )

    def _times(self, cloud: Cloud) -> tuple[NDArray[np.int64], int, PointTime]:
        """Time of every point, reference time of the scan, and where they come from."""
        count = len(cloud.x_m)
        stamp_ns = cloud.receive_ns if self.settings.stamp_source == "receive" else cloud.stamp_ns
        if self.settings.point_time == "none" or cloud.compensated:
            return np.full(count, stamp_ns, np.int64), stamp_ns, "none"
        if self.settings.point_time == "auto" and cloud.time_ns is not None:
            first, last = int(cloud.time_ns.min()), int(cloud.time_ns.max())
            if self._sensible(last - first, count):
                shift = stamp_ns - cloud.stamp_ns
                times = cloud.time_ns + np.int64(shift) if shift else cloud.time_ns
                return times, first + (last - first) // 2 + shift, "per point"
        share = {"start": 0.0, "middle": 0.5, "end": 1.0}[cloud.stamp_at]
        start_ns = stamp_ns - round(share * self.period_ns)
        offsets = azimuth_times(cloud, self.period_ns)
        return start_ns + offsets, start_ns + self.period_ns // 2, "from azimuth"

    def _sensible(self, span_ns: int, count: int) -> bool:
        """Whether the points' own times can be those of one sweep."""
        if span_ns == 0 and count > 1:
            self._flat_times += 1
            return False
        if span_ns > _LONGEST_SWEEPS * self.period_ns:
            self._wide_times += 1
            return False
        return True

    def _counted(self, scan: Scan) -> Scan:
        tally = self.tally
        tally.first_ns = tally.first_ns if tally.scans else int(scan.stamp_ns.min())
        tally.last_ns = max(tally.last_ns, int(scan.stamp_ns.max()))
        tally.beams = max(tally.beams, int(scan.ring.max()) + 1)
        numbered = replace(scan, scan_index=tally.scans)
        tally.scans += 1
        tally.points += len(scan)
        return numbered

    def finish(self) -> ScanTally:
        """The counts, with the problems they amount to."""
        tally = self.tally
        tally.point_time = self._kinds.most_common(1)[0][0] if self._kinds else "none"
        if tally.beams == 1:
            tally.beams = 0
        tally.problems = list(self._problems())
        return tally

    def _problems(self) -> Iterator[Problem]:
        tally, topic = self.tally, self.topic
        if self._damaged:
            text = f"{_count(len(self._damaged), 'scan')} of {topic} cannot be decoded and left out ({self._damaged[0]})."
            yield self._problem("damaged", "warning", text)
        if self._late:
            text = f"{_count(self._late, 'scan')} of {topic} came twice or too late, and left out."
            yield self._problem("late", "warning", text)
        if self._empty:
            yield self._problem(
                "empty", "warning", f"{_count(self._empty, 'scan')} of {topic} hold no point, and left out."
            )
        if self._wide_times:
            text = f"the points of {_count(self._wide_times, 'scan')} carry times that span more than {_LONGEST_SWEEPS:.0f} turns"
            yield self._problem("point_time_odd", "warning", f"In {topic} {text}; azimuth is used instead.")
        if self._kinds["from azimuth"]:
            why = "carry all the same time" if self._flat_times else "carry no time of their own"
            text = f"The points of {topic} {why}; it is derived from their azimuth, one turn in {self.period_ns / 1e6:.1f} ms."
            yield self._problem("no_point_time", "info", text)
        for remark, count in self._remarks.most_common(5):
            yield self._problem(
                "remark", "info", f"In {count} of {sum(self._kinds.values())} scans of {topic}: {remark}."
            )
        if tally.scans and tally.points / tally.scans < _FEW_POINTS:
            text = f"The scans of {topic} have {tally.points / tally.scans:.0f} points on average; a 3D LiDAR has thousands."
            yield self._problem("sparse", "warning", text)

    def _problem(self, code: str, severity: Severity, text: str) -> Problem:
        return Problem(code=f"lidar.{code}", severity=severity, text=text, topic=self.topic)


def _count(count: int, noun: str) -> str:
    return f"{count} {noun} is" if count == 1 else f"{count} {noun}s are"


def _rows(cloud: Cloud, rows: NDArray[np.int64]) -> Cloud:
    return replace(
        cloud,
        x_m=cloud.x_m[rows],
        y_m=cloud.y_m[rows],
        z_m=cloud.z_m[rows],
        intensity=cloud.intensity[rows],
        ring=cloud.ring[rows],
        return_no=cloud.return_no[rows],
        time_ns=None if cloud.time_ns is None else cloud.time_ns[rows],
    )


def too_few_scans(readable: int, source: LogSource, tally: ScanTally, where: str) -> InvalidInput:
    """The error of a log with fewer scans than a map needs, which says what became of the others."""
    why = [f"The log is damaged: {'; '.join(source.damage.texts[:3])}."] if source.damage else []
    why += [problem.text for problem in tally.problems if problem.severity == "warning"]
    scans = f"{readable} readable scan{'s' * (readable != 1)}"
    advice = "copy the log again from where it was recorded, or give another one"
    return InvalidInput(
        " ".join([f"The log holds {scans}; a map needs at least two.", *why]),
        where=where,
        next_step=advice if source.damage else "record for longer, or give another log",
    )


def _decode(message: CloudMessage) -> Cloud:
    if isinstance(message, PointCloud2):
        return decode_pointcloud2(message)
    if isinstance(message, LivoxCloud):
        return decode_livox(message)
    return message.load()


def _returns(cloud: Cloud) -> NDArray[np.bool_]:
    """Points that are measurements: not NaN, not beyond any LiDAR, not the zeros that drivers write for no return."""
    return _measured(cloud.x_m, cloud.y_m, cloud.z_m)


@kernel
def _measured(x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32]) -> NDArray[np.bool_]:
    out = np.empty(len(x), np.bool_)
    for i in range(len(x)):
        near = (abs(x[i]) < _FARTHEST_M) & (abs(y[i]) < _FARTHEST_M) & (abs(z[i]) < _FARTHEST_M)
        out[i] = near & ((x[i] != 0) | (y[i] != 0) | (z[i] != 0))
    return out
