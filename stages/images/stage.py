"""Images: the pictures of every camera of a log, thinned, on the LiDAR's clock; and each camera's lens and mounting.

A second pass over the log, which reads images and transforms only. Images stay encoded as they came; raw ones are packed
without loss. What the log does not say of a camera is taken from the session file.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby, islice

from scanloom.schemas.cameras import Cameras, Image, Images
from scanloom.schemas.product import Part
from scanloom.schemas.session import RawLog, Session
from scanloom.stages.images.footage import Projector
from scanloom.stages.logs import cameras as search
from scanloom.stages.logs.camera_options import Settings
from scanloom.stages.logs.reader import open_log
from scanloom.stages.logs.records import LogSource, PointCloud2

__all__ = ["VERSION", "Settings", "images"]

VERSION = 1


def images(settings: Settings, raw_log: RawLog, session: Session) -> Iterator[Part[Images] | Cameras]:
    """Yield the images part by part, in order of time, then the cameras.

    A log without images gives no part and an empty document. A camera whose lens is unknown is left out with a remark,
    one whose place is unknown is kept: a calibration may find it.

    Raises
    ------
    UsageError : a setting names a topic that the log does not have.
    """
    if settings.use == "none" or not (settings.cameras or _has_images(session)):
        yield Cameras()
        return
    source = open_log(raw_log)
    found = search.find_cameras(source, settings)
    lidar_frame, lag_ns = _lidar(source, session)
    shifts = {camera.topic: search.clock_shift_ns(camera, lag_ns, settings) for camera in found.usable}
    projector = Projector(settings, session, found.usable, shifts)
    if found.usable:
        pictures = projector.show(source, transforms=search.needs_tf(found))
        yield from _parts(pictures, session.start_ns, round(settings.chunk_s * 1e9))
    search.mount_cameras(found, projector.tf, lidar_frame)
    yield Cameras(
        cameras=tuple(camera.camera() for camera in found.usable),
        footage=projector.footage(),
        remarks=(*found.remarks, *projector.remarks()),
    )


def _has_images(session: Session) -> bool:
    return any(topic.role == "images" and topic.messages for topic in session.topics)


def _lidar(source: LogSource, session: Session) -> tuple[str, int]:
    """Frame of the LiDAR, and its stamps less the times of recording; from its first message."""
    topic = next((topic.name for topic in session.topics if topic.role == "lidar"), "")
    for message in islice(source.messages({topic}), 1):
        frame = message.body.frame_id if isinstance(message.body, PointCloud2) else ""
        return frame or getattr(message.body, "frame_id", ""), message.body.stamp_ns - message.body.receive_ns
    return "", 0


def _parts(pictures: Iterator[Image], start_ns: int, length_ns: int) -> Iterator[Part[Images]]:
    """Cut by time since the first scan, so that a part is the same whatever came before it."""

    def number(image: Image) -> int:
        return max(image.stamp_ns - start_ns, 0) // length_ns

    for n, group in groupby(pictures, number):
        yield Part(Images(group), f"{n:04d}")
