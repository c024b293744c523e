"""Ingest: any log becomes scans, IMU, GNSS, wheel speed and a summary, in one pass and flat memory."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, islice

from scanloom.schemas.product import Part
from scanloom.schemas.scans import Scan, Scans
from scanloom.schemas.session import RawLog, Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.reader import describe_place, open_log, session_name
from scanloom.stages.logs.records import CloudFile, LivoxCloud, LogSource, PointCloud2
from scanloom.stages.logs.roles import assign_roles, no_lidar
from scanloom.stages.logs.survey import Survey
from scanloom.stages.logs.sweeps import CloudMessage, ScanMaker, too_few_scans

__all__ = ["VERSION", "Settings", "ingest"]

VERSION = 1

Output = Part[Scans] | Imu | Gnss | Wheel | Session
_MIN_SCANS = 2


def ingest(settings: Settings, raw_log: RawLog) -> Iterator[Output]:
    """Read a log once; yield its scans chunk by chunk, then the other sensors and the summary.

    Each chunk must be consumed before the next is asked for (the engine does, while it writes).

    Raises
    ------
    InvalidInput : no log, no 3D LiDAR in it, or fewer than two scans.
    UsageError : a setting names a topic that the log does not have.
    """
    where = describe_place(raw_log)
    source = open_log(raw_log, settings.scan_rate_hz)
    roles = assign_roles(source, settings.wanted_topics())
    if not roles.lidar:
        raise no_lidar(source, where)
    survey = Survey(source, roles, settings)
    maker = ScanMaker(settings, roles.lidar, survey.period_ns())
    scans = maker.ordered(_clouds(survey, source))
    first = list(islice(scans, _MIN_SCANS))
    if len(first) < _MIN_SCANS:
        raise too_few_scans(len(first), source, maker.finish(), where)
    yield from _chunks(chain(first, scans), settings)
    imu, gnss = survey.imu(), survey.gnss()
    yield imu
    yield gnss
    yield survey.wheel()
    yield survey.session(session_name(raw_log), maker.finish(), imu, gnss)


def _clouds(survey: Survey, source: LogSource) -> Iterator[CloudMessage]:
    """The LiDAR's messages; everything else goes into the survey on the way."""
    for message in source.messages(survey.topics):
        survey.note(message)
        if message.topic == survey.roles.lidar and isinstance(
            message.body, PointCloud2 | LivoxCloud | CloudFile
        ):
            yield message.body


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
