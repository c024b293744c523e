"""The cameras of a log: which topics they are, what is known of their lenses and mounting, and what is missing.

Ingest's sister `images` and `inspect` both ask here, so that what inspect says is what is used.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.schemas.errors import UsageError
from scanloom.stages.geometry.pictures import size_of
from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.logs.camera_options import GivenCamera, Settings
from scanloom.stages.logs.camera_topics import is_picture, is_rectified, names_of, one_per_camera, place_of
from scanloom.stages.logs.lenses import model_of_info, resized
from scanloom.stages.logs.mounting import TfTree, as_matrix4
from scanloom.stages.logs.records import (
    AnyImage,
    CameraInfo,
    CompressedImage,
    ImageFile,
    LogSource,
    RawImage,
    TopicInfo,
)
from scanloom.stages.logs.roles import NONE

_LOOKED_AT = 5
_CLOCK_APART_NS = 1_000_000_000
T_BODY_OPTICAL = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
"""From a camera's axes (x right, y down, z forward) to those of its housing (x forward, y left, z up; REP 103)."""


@dataclass(frozen=True)
class FoundCamera:
    """A camera of the log with a topic of images."""

    name: str
    topic: str
    images: int
    model: CameraModel | None = None
    source: str = ""
    T_lidar_camera: F8 | None = None
    pose_source: str = ""
    frame: str = ""
    size_px: tuple[int, int] | None = None
    lag_ns: int = 0
    """Stamp less time of recording, of its first image."""
    given: GivenCamera | None = None

    @property
    def usable(self) -> bool:
        return self.model is not None

    def camera(self) -> Camera:
        """As a document has it; only of a camera whose model is known."""
        if self.model is None:
            raise ValueError(f"camera {self.name} has no model")
        given = self.given or GivenCamera(name=self.name)
        sources = dict.fromkeys(filter(None, (self.source, self.pose_source)))
        return Camera(
            name=self.name, model=self.model, T_lidar_camera=as_matrix4(self.T_lidar_camera),
            source=", ".join(sources), clock_offset_s=given.clock_offset_s, readout_s=given.readout_s,
        )  # fmt: skip


@dataclass
class Cameras:
    """What was found, and what is odd about it."""

    found: list[FoundCamera] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def usable(self) -> list[FoundCamera]:
        return [camera for camera in self.found if camera.usable]


def find_cameras(source: LogSource, settings: Settings) -> Cameras:
    """Cameras of a log with their models; looks at the first messages of their topics only.

    Raises
    ------
    UsageError : a setting names a topic that the log does not have, or that holds no images.
    """
    cameras = Cameras()
    if settings.use == "none":
        return cameras
    for camera in _chosen(source, settings, cameras.remarks):
        if camera.given is not None and camera.given.remark:
            cameras.remarks.append(camera.given.remark)
        camera = _looked_at(source, camera)
        camera = _with_model(source, camera, cameras.remarks)
        cameras.found.append(_of_that_size(camera, cameras.remarks))
    return cameras


def mount_cameras(cameras: Cameras, tf: TfTree, lidar_frame: str) -> None:
    """Fill in from tf where the cameras sit that nobody else knows of, and say of which nothing is known."""
    cameras.found = [
        _mounted(camera, tf, lidar_frame, cameras.remarks) if camera.usable else camera
        for camera in cameras.found
    ]


def needs_tf(cameras: Cameras) -> bool:
    """Whether transforms could tell something that is not known yet."""
    return any(camera.usable and camera.T_lidar_camera is None for camera in cameras.found)


def clock_shift_ns(camera: FoundCamera, lidar_lag_ns: int, settings: Settings) -> int:
    """What brings a camera with a clock of its own to the LiDAR's, from times of recording."""
    told = camera.given is not None and camera.given.clock_offset_s != 0.0
    if not settings.align_clocks or told or settings.stamp_source == "receive":
        return 0
    shift = lidar_lag_ns - camera.lag_ns
    return shift if abs(shift) > _CLOCK_APART_NS else 0


# --- which -----------------------------------------------------------------------------------------------------------


def _chosen(source: LogSource, settings: Settings, remarks: list[str]) -> list[FoundCamera]:
    """The cameras to use: those given, by topic or name, and the others of the log."""
    pictures = {topic.name: topic for topic in source.topics if topic.kind == "images" and topic.count}
    found: list[FoundCamera] = []
    taken: set[str] = set()
    for given in settings.cameras:
        if given.topic and given.topic != NONE:
            topic = _named(pictures, source, given)
            found.append(_start(topic, given.name, given))
            taken.add(place_of(topic.name))
    free = one_per_camera([t for t in pictures.values() if is_picture(t) and place_of(t.name) not in taken])
    names = names_of([topic.name for topic in free])
    by_name = {given.name: given for given in settings.cameras if given.topic in ("", NONE)}
    for topic in free:
        given_here = by_name.pop(names[topic.name], None)
        if given_here is not None and given_here.topic == NONE:
            continue
        if given_here is not None or settings.use == "all":
            found.append(_start(topic, names[topic.name], given_here))
    remarks += [_nowhere(name, names.values()) for name, given in by_name.items() if given.topic != NONE]
    return sorted(found, key=lambda camera: camera.name)


def _start(topic: TopicInfo, name: str, given: GivenCamera | None) -> FoundCamera:
    return FoundCamera(name, topic.name, topic.count, given=given)


def _named(pictures: dict[str, TopicInfo], source: LogSource, given: GivenCamera) -> TopicInfo:
    if given.topic in pictures:
        return pictures[given.topic]
    others = {topic.name: topic.type for topic in source.topics}
    if given.topic in others:
        raise UsageError(
            f"The topic of camera {given.name}, {given.topic}, is of type {others[given.topic]}.",
            next_step="name a topic of type sensor_msgs/Image or sensor_msgs/CompressedImage",
        )
    near = difflib.get_close_matches(given.topic, list(pictures) or list(others), 1, 0.3)
    hint = f"did you mean {near[0]}?" if near else "see `scanloom inspect` for the topics"
    raise UsageError(
        f"The topic of camera {given.name} is {given.topic}, which the log does not have.", next_step=hint
    )


def _nowhere(name: str, cameras: Collection[str]) -> str:
    known = f"its cameras are {', '.join(sorted(cameras))}" if cameras else "it has no images"
    return f"Camera {name} is described, but the log has none of that name ({known}); give its topic if it is there."


# --- what is known of each -------------------------------------------------------------------------------------------


def _looked_at(source: LogSource, camera: FoundCamera) -> FoundCamera:
    """Frame, size and clock of its first images."""
    for message in islice(source.messages({camera.topic}), _LOOKED_AT):
        body = message.body
        if isinstance(body, RawImage | CompressedImage | ImageFile):
            size = image_size(body)
            if size is not None:
                lag = body.stamp_ns - body.receive_ns
                return replace(camera, frame=body.frame_id, size_px=size, lag_ns=lag)
    return camera


def image_size(body: AnyImage) -> tuple[int, int] | None:
    """Width and height, px; None where the image is too damaged to tell."""
    if isinstance(body, RawImage):
        return (body.width, body.height) if body.width * body.height else None
    return size_of(bytes_of(body))


def bytes_of(body: CompressedImage | ImageFile) -> np.ndarray:
    """The encoded image; no bytes when its file cannot be read."""
    if isinstance(body, CompressedImage):
        return body.data
    try:
        return np.fromfile(body.path, np.uint8)
    except OSError:
        return np.empty(0, np.uint8)


def _with_model(source: LogSource, camera: FoundCamera, remarks: list[str]) -> FoundCamera:
    """The model and, where the same source has it, the mounting: what the user says first, then the log's calibration."""
    given = camera.given
    known = next((entry for entry in source.cameras if entry.name == camera.topic), None)
    if given is not None and given.T_lidar_camera is not None:
        camera = replace(camera, T_lidar_camera=np.array(given.T_lidar_camera), pose_source=given.source)
    elif known is not None and known.T_lidar_camera is not None:
        camera = replace(camera, T_lidar_camera=np.array(known.T_lidar_camera), pose_source=known.source)
    if given is not None and given.model is not None:
        return replace(camera, model=given.model, source=given.source)
    if known is not None:
        return replace(camera, model=known.model, source=known.source)
    return _from_info(source, camera, remarks)


def _from_info(source: LogSource, camera: FoundCamera, remarks: list[str]) -> FoundCamera:
    info, topic = _info_of(source, camera)
    if info is None:
        remarks.append(
            f"Camera {camera.name} ({camera.topic}) cannot be used: nothing tells its lens. Give its model in the session "
            f"file (cameras: {{{camera.name}: {{model: FILE}}}}: Kalibr, OpenCV or calibration.json) or record its camera info."
        )
        return camera
    try:
        model = model_of_info(info, rectified=is_rectified(camera.topic))
    except ValueError as error:
        remarks.append(
            f"Camera {camera.name} cannot be used: {topic} does not describe it, {error}. Give its model in the session "
            f"file (cameras: {{{camera.name}: {{model: FILE}}}})."
        )
        return camera
    return replace(camera, model=model, source="camera info", frame=info.frame_id or camera.frame)


def _info_of(source: LogSource, camera: FoundCamera) -> tuple[CameraInfo | None, str]:
    """Its camera info: the topic beside the images, else the one that names the same frame."""
    topics = [topic.name for topic in source.topics if topic.kind == "camera" and topic.count]
    place = place_of(camera.topic)
    beside = [t for t in topics if t.strip("/").rpartition("/")[0] in (place, camera.topic.strip("/"))]
    for topic in (*beside, *(t for t in topics if t not in beside)):
        for message in islice(source.messages({topic}), _LOOKED_AT):
            body = message.body
            if isinstance(body, CameraInfo):
                if topic in beside or (body.frame_id and body.frame_id == camera.frame):
                    return body, topic
                break
    return None, ""


def _of_that_size(camera: FoundCamera, remarks: list[str]) -> FoundCamera:
    """The model for images of the size they have; none when they cannot be this camera's."""
    model, size = camera.model, camera.size_px
    if model is None or size is None or size == (model.width_px, model.height_px):
        return camera
    told = f"Images of camera {camera.name} are {size[0]} x {size[1]} px, its model is of {model.width_px} x {model.height_px} px"  # fmt: skip
    scaled = resized(model, *size)
    if scaled is None:
        remarks.append(f"{told}: that is another camera or a cut of its image, so it is not used.")
        return replace(camera, model=None)
    remarks.append(f"{told}; the model is scaled.")
    return replace(camera, model=scaled)


def _mounted(camera: FoundCamera, tf: TfTree, lidar_frame: str, remarks: list[str]) -> FoundCamera:
    if camera.T_lidar_camera is not None:
        return camera
    T = tf.between(lidar_frame, camera.frame) if lidar_frame and camera.frame else None
    if T is None:
        remarks.append(
            f"Nobody says where camera {camera.name} sits (no rigid tf from {lidar_frame or 'the LiDAR'} to "
            f"{camera.frame or 'its frame'}). Give T_lidar_camera in the session file, or find it with `scanloom calibrate`."
        )
        return camera
    if _is_housing(T, camera.frame):
        remarks.append(
            f"Frame {camera.frame} of camera {camera.name} has the axes of a housing (x forward), not of an image "
            "(z forward); it is turned. Give T_lidar_camera in the session file if that is wrong."
        )
        T = T @ T_BODY_OPTICAL
    return replace(camera, T_lidar_camera=T, pose_source="tf")


def _is_housing(T_lidar_camera: F8, frame: str) -> bool:
    """A camera that would look straight up while its x axis is level, and is not called optical, has the other axes."""
    forward, right = T_lidar_camera[:3, 2], T_lidar_camera[:3, 0]
    return "optical" not in frame.lower() and bool(forward[2] > 0.8) and bool(abs(right[2]) < 0.5)
