"""A log of one or several container files (rosbag1, rosbag2, MCAP) as one `LogSource`."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera
from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import Extrinsic, Problem, RawLog
from scanloom.stages.logs.containers import Channel, Container
from scanloom.stages.logs.database import DatabaseFile
from scanloom.stages.logs.mcap import McapFile
from scanloom.stages.logs.messages import decode, kind_of, ros2_name
from scanloom.stages.logs.packed import PackedFile
from scanloom.stages.logs.records import Damage, Message, TopicInfo
from scanloom.stages.logs.rosbag import Rosbag1File

_ENCODINGS = ("cdr", "ros1")
_TF_ALL, _TF_EVERY = 1000, 50


@dataclass
class BagLog:
    """Container files in order of time; topics of the same name are one topic."""

    format: str
    files: list[Container]
    extrinsics: tuple[Extrinsic, ...] = ()
    cameras: tuple[Camera, ...] = ()
    topics: tuple[TopicInfo, ...] = ()
    opening: Damage = field(default_factory=Damage)
    unstamped: Counter[str] = field(default_factory=Counter)
    """Messages per topic whose header has no stamp; they get their receive time."""

    def __post_init__(self) -> None:
        self.files.sort(key=lambda file: _range(file)[0])
        self.topics = _topics(self.files)

    @property
    def damage(self) -> Damage:
        """What was lost in any of the files so far."""
        total = Damage(list(self.opening.texts), self.opening.lost_bytes)
        for file in self.files:
            total.lost_bytes += file.damage.lost_bytes
            total.texts += [f"{file.path.name}: {text}" for text in file.damage.texts]
        return total

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What reading found odd so far."""
        return tuple(
            Problem(
                code="log.unstamped",
                severity="warning",
                text=f"{count} messages of {topic} have no stamp in their header; they get the time of recording.",
                topic=topic,
            )
            for topic, count in sorted(self.unstamped.items())
        )

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Decoded messages of the topics in order of receive time."""
        self.unstamped.clear()
        for group in _groups(self.files):
            streams = [self._decoded(file, topics) for file in group]
            merged = streams[0] if len(streams) == 1 else heapq.merge(*streams, key=_receive_ns)
            for _, message in merged:
                yield message

    def _decoded(self, file: Container, topics: Collection[str]) -> Iterator[tuple[int, Message]]:
        channels = file.channels
        wanted = {
            number
            for number, channel in channels.items()
            if channel.topic in topics and channel.encoding in _ENCODINGS and kind_of(channel.type) != "other"
        }
        seen: Counter[int] = Counter()
        for raw in file.read(wanted):
            channel = channels[raw.channel]
            seen[raw.channel] += 1
            if _superfluous(channel, seen[raw.channel]):
                continue
            body = decode(raw.data, channel.type, channel.encoding, channel.topic, raw.receive_ns)
            if body.stamp_ns == 0 and raw.receive_ns:
                self.unstamped[channel.topic] += 1
                body = replace(body, stamp_ns=raw.receive_ns)
            yield raw.receive_ns, Message(channel.topic, body)


def _superfluous(channel: Channel, number: int) -> bool:
    """Of transforms sent again and again a sample tells whether they move; decoding all would take minutes an hour."""
    again = kind_of(channel.type) == "tf" and number > _TF_ALL
    return again and number % _TF_EVERY != 0


def _receive_ns(pair: tuple[int, Message]) -> int:
    return pair[0]


def _range(file: Container) -> tuple[int, int]:
    stamps = [values for values in file.stamps.values() if len(values)]
    if not stamps:
        return 0, 0
    return min(int(values[0]) for values in stamps), max(int(values[-1]) for values in stamps)


def _groups(files: Sequence[Container]) -> Iterator[list[Container]]:
    """Files that overlap in time are read together, others one after the other."""
    group: list[Container] = []
    end_ns = 0
    for file in files:
        first, last = _range(file)
        if group and first > end_ns:
            yield group
            group = []
        group.append(file)
        end_ns = max(end_ns, last)
    if group:
        yield group


def _topics(files: Sequence[Container]) -> tuple[TopicInfo, ...]:
    stamps: dict[str, list[NDArray[np.int64]]] = {}
    types: dict[str, tuple[str, str]] = {}
    for file in files:
        found = file.stamps
        for number, channel in file.channels.items():
            types.setdefault(channel.topic, (channel.type, channel.encoding))
            stamps.setdefault(channel.topic, []).append(found.get(number, np.empty(0, np.int64)))
    return tuple(
        _info(topic, *types[topic], np.sort(np.concatenate(parts))) for topic, parts in sorted(stamps.items())
    )


def _info(topic: str, type_name: str, encoding: str, stamps: NDArray[np.int64]) -> TopicInfo:
    known = encoding in _ENCODINGS
    return TopicInfo(
        name=topic,
        type=ros2_name(type_name),
        kind=kind_of(type_name) if known else "other",
        count=len(stamps),
        first_ns=int(stamps[0]) if len(stamps) else 0,
        last_ns=int(stamps[-1]) if len(stamps) else 0,
        period_ns=int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0,
        remark="" if known else f"encoding {encoding!r} cannot be read",
    )


def open_bags(raw_log: RawLog, format: str) -> BagLog:
    """Open all files of a bag; those that cannot be opened are damage as long as one can.

    Raises
    ------
    InvalidInput : none can be opened.
    """
    files: list[Container] = []
    opening = Damage()
    errors: list[InvalidInput] = []
    for name in raw_log.names:
        opener = _opener(name)
        if opener is None:
            continue
        try:
            files.append(_opened(opener, raw_log.path(name)))
        except InvalidInput as error:
            errors.append(error)
            opening.texts.append(f"{name} cannot be opened: {error.what}")
            opening.lost_bytes += raw_log.path(name).stat().st_size
    opening.texts += _missing_parts(raw_log, files)
    if not files:
        raise errors[0] if errors else InvalidInput("The folder holds no bag file.", where=str(raw_log.root))
    return BagLog(format, files, opening=opening)


def _opened(opener: Callable[[Path], Container], path: Path) -> Container:
    try:
        return opener(path)
    except OSError as error:
        raise InvalidInput(
            f"The file cannot be read ({error.strerror}).",
            where=str(path),
            next_step="check the file and the free space",
        ) from error


def _opener(name: str) -> Callable[[Path], Container] | None:
    if name.endswith(".zstd"):
        inner = _opener(name.removesuffix(".zstd"))
        return _packed(inner) if inner else None
    return _OPENERS.get(Path(name).suffix.lower())


def _packed(inner: Callable[[Path], Container]) -> Callable[[Path], Container]:
    return lambda path: PackedFile(path, inner)


_OPENERS: dict[str, Callable[[Path], Container]] = {
    ".mcap": McapFile,
    ".bag": Rosbag1File,
    ".active": Rosbag1File,
    ".db3": DatabaseFile,
}


def _missing_parts(raw_log: RawLog, files: Sequence[Container]) -> Iterator[str]:
    """What a rosbag2 folder's metadata promises and the folder does not hold."""
    name = next((name for name in raw_log.names if Path(name).name == "metadata.yaml"), "")
    if not name:
        return
    try:
        content = yaml.safe_load(raw_log.path(name).read_text(encoding="utf-8"))
        about = content["rosbag2_bagfile_information"]
        parts = [Path(str(part)).name for part in about["relative_file_paths"]]
        promised = int(about["message_count"])
        span_s = int(about["duration"]["nanoseconds"]) / 1e9
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, ValueError):
        yield "metadata.yaml cannot be read; the bag files themselves are used"
        return
    held = {Path(name).name for name in raw_log.names}
    missing = [part for part in parts if part not in held and part.removesuffix(".zstd") not in held]
    if missing:
        yield f"{len(missing)} of {len(parts)} files of the bag are missing ({', '.join(missing[:3])})"
    found = sum(len(stamps) for file in files for stamps in file.stamps.values())
    if found < promised:
        share = 1 - found / promised
        yield f"{promised - found} of {promised} messages are missing (about {share * span_s:.1f} of {span_s:.1f} s)"
