"""The images of a log on their way through: thinned, stamped by the LiDAR's clock, in order of time."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

from scanloom.schemas.cameras import Footage, Image
from scanloom.schemas.session import Session
from scanloom.stages.images.packing import packed
from scanloom.stages.logs.camera_options import Settings
from scanloom.stages.logs.cameras import FoundCamera
from scanloom.stages.logs.mounting import TfTree
from scanloom.stages.logs.records import (
    AnyImage,
    CompressedImage,
    ImageFile,
    LogSource,
    RawImage,
    Transforms,
    Undecodable,
)

_HOLD_NS = 2_000_000_000
"""Images of different cameras may be recorded in another order than they were taken; so much is put right."""
_BESIDE_NS = 1_000_000_000
"""Images so much before the first scan or after the last are of no use."""
_ENOUGH = 0.9
"""Share of the spacing that is enough: the clocks of cameras jitter."""


@dataclass
class _Roll:
    """One camera's images so far."""

    camera: FoundCamera
    shift_ns: int
    kept: int = 0
    damaged: int = 0
    reason: str = ""
    outside: int = 0
    late: int = 0
    first_ns: int = 0
    last_ns: int | None = None

    def footage(self) -> Footage:
        return Footage(
            camera=self.camera.name, topic=self.camera.topic, images=self.camera.images, kept=self.kept,
            damaged=self.damaged, first_ns=self.first_ns, last_ns=self.last_ns or 0,
        )  # fmt: skip

    def remarks(self) -> Iterator[str]:
        name, topic = self.camera.name, self.camera.topic
        if self.damaged:
            yield f"{self.damaged} images of {topic} are damaged ({self.reason}) and are left out."
        if self.late:
            yield f"{self.late} images of {topic} are older than one before them and are left out."
        if self.shift_ns:
            yield (
                f"{topic} is stamped by another clock than the LiDAR. Its stamps are shifted by {self.shift_ns / 1e9:.3f} s, "
                f"as the times of recording suggest (good to some milliseconds); give cameras.{name}.clock_offset_s if you know."
            )
        if self.outside and not self.kept:
            yield f"{topic} does not overlap the LiDAR's scans in time; check the clocks or cameras.{name}.clock_offset_s."


class Projector:
    """Reads the images of the usable cameras, and transforms if they are needed, in one pass."""

    def __init__(
        self, settings: Settings, session: Session, cameras: list[FoundCamera], shifts_ns: dict[str, int]
    ) -> None:
        self.settings, self.tf = settings, TfTree()
        self._rolls = {camera.topic: _Roll(camera, shifts_ns.get(camera.topic, 0)) for camera in cameras}
        self._span = (session.start_ns - _BESIDE_NS, session.end_ns + _BESIDE_NS)
        self._spacing_ns = max(round(settings.spacing_s * _ENOUGH * 1e9), 1)

    def footage(self) -> tuple[Footage, ...]:
        return tuple(roll.footage() for roll in self._rolls.values())

    def remarks(self) -> list[str]:
        return [text for roll in self._rolls.values() for text in roll.remarks()]

    def show(self, source: LogSource, *, transforms: bool) -> Iterator[Image]:
        """Images in order of time."""
        waiting: list[tuple[int, str, Image]] = []
        newest = last = self._span[0]
        for image in self._kept(source, transforms):
            if image.stamp_ns < last:
                self._rolls[image.topic].late += 1
                continue
            heapq.heappush(waiting, (image.stamp_ns, image.camera, image))
            newest = max(newest, image.stamp_ns)
            while waiting[0][0] < newest - _HOLD_NS:
                last, _, oldest = heapq.heappop(waiting)
                yield self._counted(oldest)
        while waiting:
            yield self._counted(heapq.heappop(waiting)[2])

    def _kept(self, source: LogSource, transforms: bool) -> Iterator[Image]:
        topics = set(self._rolls)
        if transforms:
            topics |= {topic.name for topic in source.topics if topic.kind == "tf"}
        for message in source.messages(topics):
            body = message.body
            if isinstance(body, Transforms):
                self.tf.note(body)
            elif isinstance(body, RawImage | CompressedImage | ImageFile):
                image = self._image(self._rolls[message.topic], body)
                if image is not None:
                    yield image
            elif isinstance(body, Undecodable) and message.topic in self._rolls:
                roll = self._rolls[message.topic]
                roll.damaged, roll.reason = roll.damaged + 1, roll.reason or body.reason

    def _image(self, roll: _Roll, body: AnyImage) -> Image | None:
        """The image if it is to be kept."""
        stamp_ns = self._stamp_ns(roll, body)
        if not self._span[0] <= stamp_ns <= self._span[1]:
            roll.outside += 1
            return None
        if roll.last_ns is not None and stamp_ns - roll.last_ns < self._spacing_ns:
            roll.late += stamp_ns < roll.last_ns
            return None
        try:
            data, encoding = packed(body)
        except ValueError as error:
            roll.damaged, roll.reason = roll.damaged + 1, roll.reason or str(error)
            return None
        roll.last_ns = stamp_ns
        return Image(
            data=data, stamp_ns=stamp_ns, camera=roll.camera.name, encoding=encoding, topic=roll.camera.topic
        )

    def _stamp_ns(self, roll: _Roll, body: AnyImage) -> int:
        stamp_ns = body.receive_ns if self.settings.stamp_source == "receive" else body.stamp_ns
        given = roll.camera.given
        offset_ns = round(given.clock_offset_s * 1e9) if given is not None else 0
        return stamp_ns + roll.shift_ns - offset_ns

    def _counted(self, image: Image) -> Image:
        roll = self._rolls[image.topic]
        roll.first_ns = roll.first_ns if roll.kept else image.stamp_ns
        roll.kept += 1
        return image
