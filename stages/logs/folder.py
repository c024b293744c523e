"""A folder of files as a log: scans one at a time, everything else in memory."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from scanloom.schemas.cameras import Camera
from scanloom.schemas.session import Extrinsic, Problem, Severity
from scanloom.stages.logs.records import (
    CloudFile,
    Damage,
    GnssSample,
    ImageFile,
    ImuSample,
    Message,
    TopicInfo,
)

Timed = ImuSample | GnssSample | ImageFile


class FolderLog:
    """A `LogSource` over files: scans are read one at a time, the rest is small and in memory."""

    def __init__(
        self,
        format_name: str,
        scans: list[CloudFile],
        others: Mapping[str, Sequence[ImuSample] | Sequence[GnssSample]],
        extrinsics: tuple[Extrinsic, ...] = (),
        problems: tuple[Problem, ...] = (),
        *,
        scan_topic: str,
        images: dict[str, list[ImageFile]] | None = None,
        cameras: tuple[Camera, ...] = (),
    ) -> None:
        self.format = format_name
        self.extrinsics = extrinsics
        self.problems = problems
        self.cameras = cameras
        self.damage = Damage()
        self._scan_topic = scan_topic
        self._scans = scans
        self._others: dict[str, Sequence[Timed]] = {**others, **(images or {})}
        stamps = {scan_topic: [scan.stamp_ns for scan in scans]}
        stamps |= {
            topic: [sample.stamp_ns for sample in samples]
            for topic, samples in self._others.items()
            if samples
        }
        self.topics = tuple(_topic(name, scan_topic, values) for name, values in stamps.items() if values)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Messages of the given topics in order of time."""
        streams: list[list[Message]] = []
        if self._scan_topic in topics:
            streams.append([Message(self._scan_topic, scan) for scan in self._scans])
        for topic, samples in self._others.items():
            if topic in topics:
                streams.append([Message(topic, sample) for sample in samples])
        yield from heapq.merge(*streams, key=lambda message: message.body.stamp_ns)


def _topic(name: str, scan_topic: str, stamps: list[int]) -> TopicInfo:
    ordered = sorted(stamps)
    period = int(np.median(np.diff(ordered))) if len(ordered) > 1 else 0
    if name == scan_topic:
        return TopicInfo(
            name, "sensor_msgs/msg/PointCloud2", "cloud", len(stamps), ordered[0], ordered[-1], period
        )
    if name.startswith("image_"):
        return TopicInfo(name, "image files", "images", len(stamps), ordered[0], ordered[-1], period)
    if name.endswith("imu"):
        return TopicInfo(name, "sensor_msgs/msg/Imu", "imu", len(stamps), ordered[0], ordered[-1], period)
    return TopicInfo(name, "sensor_msgs/msg/NavSatFix", "gnss", len(stamps), ordered[0], ordered[-1], period)


def problem(code: str, severity: Severity, text: str, topic: str = "", stamp_ns: int = 0) -> Problem:
    """Something odd in a folder."""
    return Problem(code=code, severity=severity, text=text, topic=topic, stamp_ns=stamp_ns)


def ranges(numbers: list[int], most: int = 5) -> str:
    """`3, 7 to 9, 12`, at most a few."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    words = [str(a) if a == b else f"{a} to {b}" for a, b in runs[:most]]
    return ", ".join(words) + (", ..." if len(runs) > most else "")
