"""A calibration session from a log: where the board stands still in it, some scans of each place, and the images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.calibrate.board import Board, read_board
from scanloom.stages.calibrate.image import grey
from scanloom.stages.calibrate.standstill import Standstill, StandstillSettings, Watch, standstills
from scanloom.stages.images.packing import packed
from scanloom.stages.logs import camera_options, options
from scanloom.stages.logs import cameras as search
from scanloom.stages.logs.cameras import FoundCamera
from scanloom.stages.logs.locate import Located, locate
from scanloom.stages.logs.mounting import TfTree
from scanloom.stages.logs.reader import open_log
from scanloom.stages.logs.records import (
    AnyImage,
    CloudFile,
    CompressedImage,
    ImageFile,
    LivoxCloud,
    LogSource,
    PointCloud2,
    RawImage,
    Transforms,
)
from scanloom.stages.logs.roles import assign_roles, no_lidar
from scanloom.stages.logs.sweeps import CloudMessage, ScanMaker
from scanloom.workflows.calibration_folder import CalibrationSession, PointCloud, Shown
from scanloom.workflows.calibration_place import LogPlacement, Place

SettingsT = TypeVar("SettingsT", bound=BaseModel)
_SAMPLES = (1, 8, 32, 128)
"""Images that are kept for the message when no image shows the board."""


@dataclass(frozen=True)
class LogSettings:
    """How a log is read, and what a standstill is; what a session file says stands behind it."""

    ingest: options.Settings = options.Settings()
    images: camera_options.Settings = camera_options.Settings()
    standstill: StandstillSettings = StandstillSettings()


def read_log(path: Path, board: Path | None, settings: LogSettings) -> CalibrationSession:
    """The placements of a log, in two passes: where the board stands, then the scans and images of these times.

    Raises
    ------
    InvalidInput : it is no log, it has no LiDAR or no camera whose lens is known, or the board never stands still.
    UsageError : a setting names a topic that the log does not have.
    """
    located = _located(path)
    settings = LogSettings(
        _merged("ingest", settings.ingest, located),
        _merged("images", settings.images, located),
        settings.standstill,
    )
    board_file = board or _board_file(path, located)
    reading = _Reading.of(located, read_board(board_file), settings, str(path))
    found = reading.watch()
    placements, unused = reading.take(found) if found else (reading.samples(), {})
    if not placements:
        raise _no_scan(found, str(path))
    cameras = {camera.name: camera.camera() for camera in reading.cameras.usable}
    remarks = tuple(reading.cameras.remarks)
    return CalibrationSession(
        path, reading.board, board_file, cameras, placements, unused, str(path), str(path), remarks
    )


def _located(path: Path) -> Located:
    try:
        return locate(path)
    except InvalidInput as error:
        if not path.is_dir():
            raise
        advice = f"{error.next_step}; or a folder with clouds/, images/, camera_info.yaml and board.yaml"
        raise InvalidInput(error.what, where=error.where, next_step=advice.lstrip("; ")) from error


def _merged(stage: str, given: SettingsT, located: Located) -> SettingsT:
    """The user's settings over those of the session file."""
    values = {**located.settings.get(stage, {}), **given.model_dump(exclude_unset=True)}
    try:
        return type(given).model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        raise UsageError(f"{stage}.{name}: {first['msg']}", next_step="correct the session file") from error


def _board_file(path: Path, located: Located) -> Path:
    """In the session's folder or beside the log."""
    root = located.raw_log.root or Path()
    folders = (path if path.is_dir() else path.parent, root, root.parent)
    return next(
        (f for folder in folders if (f := folder / "board.yaml").is_file()), folders[0] / "board.yaml"
    )


# --- reading ---------------------------------------------------------------------------------------------------------


@dataclass
class _Reading:
    """An open log with its LiDAR and cameras."""

    where: str
    source: LogSource
    board: Board
    settings: LogSettings
    lidar: str
    frame: str
    cameras: search.Cameras
    shift_ns: dict[str, int]
    """By topic of images."""
    _kept: list[LogPlacement] = field(default_factory=list)

    @classmethod
    def of(cls, located: Located, board: Board, settings: LogSettings, where: str) -> _Reading:
        source = open_log(located.raw_log, settings.ingest.scan_rate_hz)
        lidar = assign_roles(source, settings.ingest.wanted_topics()).lidar
        if not lidar:
            raise no_lidar(source, where)
        cameras = search.find_cameras(source, settings.images)
        if not cameras.usable:
            raise _no_camera(cameras, where)
        frame, lag_ns = _first_cloud(source, lidar)
        shifts = {c.topic: search.clock_shift_ns(c, lag_ns, settings.images) for c in cameras.usable}
        return cls(where, source, board, settings, lidar, frame, cameras, shifts)

    def watch(self) -> list[Standstill]:
        """First pass: where the board stands.

        Raises
        ------
        InvalidInput : it is seen, and never stands.
        """
        settings, by_topic = self.settings.standstill, {c.topic: c for c in self.cameras.usable}
        watches = {
            c.topic: Watch(c.name, c.model, self.board, settings) for c in self.cameras.usable if c.model
        }
        tf = TfTree()
        for topic, body in self._messages({*by_topic, *self._tf_topics()}):
            if isinstance(body, Transforms):
                tf.note(body)
            elif isinstance(body, RawImage | CompressedImage | ImageFile):
                stamp_ns = self._stamp_ns(by_topic[topic], body)
                if watches[topic].wants(stamp_ns):
                    self._look(watches[topic], body, stamp_ns)
        known = len(self.cameras.remarks)
        search.mount_cameras(self.cameras, tf, self.frame)
        del self.cameras.remarks[known:]  # they advise to calibrate
        found = standstills(watches.values(), settings)
        if not found and any(watch.boards for watch in watches.values()):
            raise _never_still(settings, self.where)
        return found

    def take(self, found: list[Standstill]) -> tuple[tuple[Shown, ...], dict[str, str]]:
        """Second pass: scans and images of every standstill; and those without scans, with the reason."""
        places = [Place(one) for one in found]
        cameras = {c.topic: c for c in self.cameras.usable}

        def clouds() -> Iterator[CloudMessage]:
            for topic, body in self._messages({self.lidar, *cameras}):
                if isinstance(body, PointCloud2 | LivoxCloud | CloudFile):
                    yield body
                elif isinstance(body, RawImage | CompressedImage | ImageFile):
                    stamp_ns = self._stamp_ns(cameras[topic], body)
                    for place in places:
                        place.note_image(cameras[topic].name, stamp_ns, body)

        period_ns = next(t.period_ns for t in self.source.topics if t.name == self.lidar)
        maker = ScanMaker(self.settings.ingest, self.lidar, period_ns)
        for scan in maker.ordered(clouds()):
            for place in places:
                place.note_scan(scan, self.settings.standstill)
        first_ns = maker.finish().first_ns
        placements, unused = [], {}
        for place in places:
            name = f"{max(place.still.middle_ns - first_ns, 0) / 1e9:06.1f}s"
            if place.scans:
                placements.append(LogPlacement(name, place.cloud(), place.encoded(), self.where))
            else:
                unused[name] = "no scan lies within this standstill: do the clocks of LiDAR and camera agree?"
        return tuple(placements), unused

    def samples(self) -> tuple[Shown, ...]:
        """Images without a board, for a message of what they show instead."""
        return tuple(self._kept)

    def _look(self, watch: Watch, body: AnyImage, stamp_ns: int) -> None:
        try:
            data = packed(body)[0].tobytes()
        except ValueError:
            return
        image = grey(data)
        if image is None or image.shape[::-1] != (watch.model.width_px, watch.model.height_px):
            return
        watch.look(stamp_ns, image)
        if watch.images in _SAMPLES:
            nothing = PointCloud(np.zeros((0, 3)), np.zeros(0), None)
            self._kept.append(
                LogPlacement(f"image {watch.images}", nothing, {watch.camera: data}, self.where)
            )

    def _messages(self, topics: set[str]) -> Iterator[tuple[str, object]]:
        for message in self.source.messages(topics):
            yield message.topic, message.body

    def _tf_topics(self) -> set[str]:
        if not search.needs_tf(self.cameras):
            return set()
        return {topic.name for topic in self.source.topics if topic.kind == "tf"}

    def _stamp_ns(self, camera: FoundCamera, body: AnyImage) -> int:
        """On the LiDAR's clock."""
        by_header = self.settings.images.stamp_source == "header"
        offset_s = camera.given.clock_offset_s if camera.given is not None else 0.0
        stamp_ns = body.stamp_ns if by_header else body.receive_ns
        return stamp_ns + self.shift_ns[camera.topic] - round(offset_s * 1e9)


def _first_cloud(source: LogSource, lidar: str) -> tuple[str, int]:
    """Frame of the LiDAR, and its stamps less the times of recording."""
    for message in source.messages({lidar}):
        body = message.body
        return getattr(body, "frame_id", ""), body.stamp_ns - body.receive_ns
    return "", 0


# --- what is wrong ---------------------------------------------------------------------------------------------------


def _no_camera(cameras: search.Cameras, where: str) -> InvalidInput:
    if not cameras.found:
        return InvalidInput(
            "The log has no images.",
            where=where,
            next_step="record the cameras' topics too, with their camera info",
        )
    return InvalidInput(
        "The log has no camera whose lens is known. " + " ".join(cameras.remarks),
        where=where,
        next_step="record the camera info, or give a session.yaml with `cameras: {NAME: {model: FILE}}`",
    )


def _no_scan(found: list[Standstill], where: str) -> InvalidInput:
    return InvalidInput(
        f"No standstill has a scan of the LiDAR in it ({len(found)} were seen by the cameras).",
        where=where,
        next_step="bring the clocks together with cameras: {NAME: {clock_offset_s: ...}} in a session.yaml",
    )


def _never_still(settings: StandstillSettings, where: str) -> InvalidInput:
    return InvalidInput(
        f"The board is seen, and never stands still for {settings.still_s:g} s.",
        where=where,
        next_step="hold it still for two seconds in each place, or allow more with --set standstill.still_px "
        f"(now {settings.still_px:g}) and standstill.still_s",
    )
