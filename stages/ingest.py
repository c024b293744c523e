"""Ingest: any log becomes scans, IMU, GNSS, wheel speed and a summary, in one pass and flat memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.product import Part
from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import RawLog, Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.pointcloud import azimuth_times, decode_livox, decode_pointcloud2
from scanloom.stages.logs.reader import open_log
from scanloom.stages.logs.records import Cloud, CloudFile, LivoxCloud, LogSource, PointCloud2
from scanloom.stages.logs.roles import assign_roles, no_lidar
from scanloom.stages.logs.survey import CLOUDS, PointTime, ScanTally, Survey

__all__ = ["VERSION", "Settings", "ingest"]

VERSION = 1

Output = Part[Scans] | Imu | Gnss | Wheel | Session
_REORDER_DEPTH = 3
_MIN_SCANS = 2


def ingest(settings: Settings, raw_log: RawLog) -> Iterator[Output]:
    """Read a log once; yield its scans chunk by chunk, then the other sensors and the summary.

    Each chunk must be consumed before the next is asked for (the engine does, while it writes).

    Raises
    ------
    InvalidInput : no log, no 3D LiDAR in it, or fewer than two scans.
    UsageError : a setting names a topic that the log does not have.
    """
    where = str(raw_log.root)
    source = open_log(raw_log, settings.scan_rate_hz)
    roles = assign_roles(source, settings.wanted_topics())
    if not roles.lidar:
        raise no_lidar(source, where)
    survey = Survey(source, roles, settings)
    maker = _ScanMaker(settings, _period_ns(source, roles.lidar, settings))
    scans = maker.ordered(_clouds(survey, source))
    first = _at_least_two(scans, source, where)
    yield from _chunks(chain(first, scans), settings)
    imu, gnss = survey.imu(), survey.gnss()
    yield imu
    yield gnss
    yield survey.wheel()
    yield survey.session("", maker.finish(), imu, gnss)


def _period_ns(source: LogSource, topic: str, settings: Settings) -> int:
    """Duration of a sweep, from the rate of the topic."""
    found = next((t.period_ns for t in source.topics if t.name == topic), 0)
    return found or round(1e9 / settings.scan_rate_hz)


def _clouds(survey: Survey, source: LogSource) -> Iterator[PointCloud2 | LivoxCloud | CloudFile]:
    """The LiDAR's messages; everything else goes into the survey on the way."""
    for message in source.messages(survey.topics):
        survey.note(message)
        if message.topic == survey.roles.lidar and isinstance(message.body, CLOUDS):
            yield message.body


def _at_least_two(scans: Iterator[Scan], source: LogSource, where: str) -> list[Scan]:
    first = [scan for _, scan in zip(range(_MIN_SCANS), scans, strict=False)]
    if len(first) < _MIN_SCANS:
        damage = f" The log is damaged: {'; '.join(source.damage.texts)}." if source.damage else ""
        raise InvalidInput(
            f"The log holds {len(first)} readable scan{'s' * (len(first) != 1)}; a map needs at least two.{damage}",
            where=where,
            next_step="copy the log again from where it was recorded, or give another one"
            if damage
            else "record for longer, or give another log",
        )
    return first


def _chunks(scans: Iterator[Scan], settings: Settings) -> Iterator[Part[Scans]]:
    """Cut the scans into chunks; the next chunk starts where the last was consumed."""
    head: list[Scan] = []

    def one_chunk() -> Iterator[Scan]:
        first = head.pop()
        points, end_ns = 0, first.reference_ns + round(settings.chunk_s * 1e9)
        for scan in chain([first], scans):
            points += len(scan)
            if scan is not first and (scan.reference_ns >= end_ns or points > settings.chunk_points):
                head.append(scan)
                return
            yield scan

    number = 0
    while head or _fill(head, scans):
        chunk = one_chunk()
        yield Part(Scans(chunk), f"{number:04d}")
        # whatever the consumer left is read and dropped, so that nothing enters the next chunk
        for _ in chunk:
            pass
        number += 1


def _fill(head: list[Scan], scans: Iterator[Scan]) -> bool:
    scan = next(scans, None)
    if scan is not None:
        head.append(scan)
    return scan is not None


class _ScanMaker:
    """Turns decoded clouds into scans in order of time, and counts what it drops."""

    def __init__(self, settings: Settings, period_ns: int) -> None:
        self.settings, self.period_ns = settings, period_ns
        self.tally = ScanTally()
        self._kinds: Counter[PointTime] = Counter()
        self._remarks: dict[str, int] = {}
        self._damaged: list[str] = []
        self._late = self._empty = 0

    def ordered(self, clouds: Iterator[PointCloud2 | LivoxCloud | CloudFile]) -> Iterator[Scan]:
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

    def _scans(self, clouds: Iterator[PointCloud2 | LivoxCloud | CloudFile]) -> Iterator[Scan]:
        for message in clouds:
            try:
                cloud = _decode(message)
            except InvalidInput as error:
                self._damaged.append(error.what)
                continue
            if cloud.remark:
                self._remarks[cloud.remark] = self._remarks.get(cloud.remark, 0) + 1
            scan = self._scan(cloud)
            if scan is None:
                self._empty += 1
            else:
                yield scan

    def _scan(self, cloud: Cloud) -> Scan | None:
        time_ns, reference_ns, kind = self._times(cloud)
        keep = _returns(cloud)
        kept = int(np.count_nonzero(keep))
        self.tally.no_return += len(keep) - kept
        if not kept:
            return None
        self._kinds[kind] += 1
        rows = slice(None) if kept == len(keep) else np.flatnonzero(keep)
        stamps = time_ns[rows]
        if reference_ns is None:
            first, last = int(stamps.min()), int(stamps.max())
            reference_ns = first + (last - first) // 2
        return Scan(
            stamp_ns=stamps,
            x_m=cloud.x_m[rows],
            y_m=cloud.y_m[rows],
            z_m=cloud.z_m[rows],
            intensity=cloud.intensity[rows],
            ring=cloud.ring[rows],
            return_no=cloud.return_no[rows],
            reference_ns=reference_ns,
            scan_index=0,
        )

    def _times(self, cloud: Cloud) -> tuple[NDArray[np.int64], int | None, PointTime]:
        """Time of every point, reference time (None: middle of the points' times), where they come from."""
        count = len(cloud.x_m)
        stamp_ns = cloud.receive_ns if self.settings.stamp_source == "receive" else cloud.stamp_ns
        if self.settings.point_time == "none" or cloud.compensated:
            return np.full(count, stamp_ns, np.int64), stamp_ns, "none"
        if self.settings.point_time == "auto" and cloud.time_ns is not None:
            return cloud.time_ns + (stamp_ns - cloud.stamp_ns), None, "per point"
        share = {"start": 0.0, "middle": 0.5, "end": 1.0}[cloud.stamp_at]
        start_ns = stamp_ns - round(share * self.period_ns)
        offsets = azimuth_times(cloud, self.period_ns)
        return start_ns + offsets, start_ns + self.period_ns // 2, "from azimuth"

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
        return tally


def _decode(message: PointCloud2 | LivoxCloud | CloudFile) -> Cloud:
    if isinstance(message, PointCloud2):
        return decode_pointcloud2(message)
    if isinstance(message, LivoxCloud):
        return decode_livox(message)
    return message.load()


def _returns(cloud: Cloud) -> NDArray[np.bool_]:
    """Points that are measurements: finite, and not the zeros that drivers write where nothing came back."""
    x, y, z = cloud.x_m, cloud.y_m, cloud.z_m
    finite: NDArray[np.bool_] = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    return finite & ((x != 0) | (y != 0) | (z != 0))
