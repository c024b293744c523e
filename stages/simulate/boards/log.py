"""A calibration session as a log: the board is carried from place to place and held still, all sensors run on.

Every turn of the LiDAR and every image is a snapshot: a board that is carried is smeared in images, not bent in clouds.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log
from scanloom.stages.simulate.boards.files import board_yaml, png, write_truth
from scanloom.stages.simulate.boards.scan import Cloud
from scanloom.stages.simulate.boards.session import BoardSession
from scanloom.stages.simulate.eye import F4
from scanloom.stages.simulate.pictures import IMAGE, INFO, image_topic, info_topic, lens_message
from scanloom.stages.simulate.recording import (
    LIDAR,
    LOG_FILE,
    TYPES,
    Entry,
    Recorder,
    class_of,
    cloud_message,
    header,
    serialised,
)
from scanloom.stages.simulate.sweeping import Sweep

_START_NS = 1_700_000_000_000_000_000
_LIDAR_DELAY_NS, _IMAGE_DELAY_NS = 4_000_000, 31_000_000
"""From measurement to recorder."""
_WHOLE = 1e-6
"""A last turn or image that falls on the end of the log, but for rounding, is in it."""


@dataclass(frozen=True)
class Timing:
    """How long the board is held and carried, and how often the sensors look."""

    held_s: float = 3.0
    carried_s: float = 1.5
    turn_s: float = 0.1
    image_s: float = 0.25


@dataclass(frozen=True)
class Moment:
    """Where the board is at one time."""

    stand: int
    T_lidar_board: F8
    held: bool


def moment(session: BoardSession, timing: Timing, time_s: float) -> Moment:
    """The board at a time since the start: held at one place, or on its way to the next."""
    step = timing.held_s + timing.carried_s
    k = min(int(time_s // step), len(session.stands) - 1)
    here = session.stands[k].T_lidar_board
    share = min(max((time_s - k * step - timing.held_s) / timing.carried_s, 0.0), 1.0)
    if share == 0.0 or k + 1 == len(session.stands):
        return Moment(k, here, True)
    eased = 3 * share**2 - 2 * share**3
    there = session.stands[k + 1].T_lidar_board
    return Moment(k, here @ se3_exp(eased * se3_log(inverse(here) @ there)), False)


def duration_s(session: BoardSession, timing: Timing) -> float:
    """From the first time the board is held to the end of the last."""
    return len(session.stands) * (timing.held_s + timing.carried_s) - timing.carried_s


def write_log(
    session: BoardSession, folder: Path, timing: Timing | None = None, truth: Path | None = None
) -> None:
    """A rosbag2 folder with clouds, images and camera infos, and board.yaml in it; the truth to `truth`, if given.

    Images are PNG. A second of it takes ten turns of the LiDAR and some images of each camera: minutes for a minute.
    """
    timing = timing or Timing()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "board.yaml").write_text(board_yaml(session))
    types = {LIDAR: TYPES[LIDAR]}
    for camera in session.given:
        types |= {image_topic(camera.name): IMAGE, info_topic(camera.name): INFO}
    recorder = Recorder(types)
    with (folder / LOG_FILE).open("wb") as stream:
        recorder.record(stream, _entries(session, timing))
    (folder / "metadata.yaml").write_bytes(recorder.metadata())
    if truth is not None:
        write_truth(session, truth)


def _entries(session: BoardSession, timing: Timing) -> Iterator[Entry]:
    """Messages in the order of their reception."""
    streams = (_turns(session, timing), _images(session, timing))
    return heapq.merge(*streams, key=lambda entry: entry[0])


def _turns(session: BoardSession, timing: Timing) -> Iterator[Entry]:
    for n in range(int(duration_s(session, timing) / timing.turn_s + _WHOLE)):
        stamp_ns = _START_NS + round(n * timing.turn_s * 1e9)
        now = moment(session, timing, (n + 0.5) * timing.turn_s)
        cloud = session.cloud_at(now.stand, now.T_lidar_board, np.random.default_rng((session.seed, 76, n)))
        received = stamp_ns + round(timing.turn_s * 1e9) + _LIDAR_DELAY_NS
        sweep = _sweep(cloud, n, stamp_ns, timing.turn_s)
        yield received, LIDAR, stamp_ns, serialised(TYPES[LIDAR], cloud_message(sweep))


def _sweep(cloud: Cloud, n: int, stamp_ns: int, turn_s: float) -> Sweep:
    """The scanner turns clockwise from behind; columns are in the order of time."""
    azimuth = np.arctan2(cloud.points_m[:, 1], cloud.points_m[:, 0])
    share = np.mod(np.pi - azimuth, 2 * np.pi) / (2 * np.pi)
    nothing = np.zeros(len(azimuth), np.uint8)
    return Sweep(
        index=n,
        start_ns=stamp_ns,
        xyz=cloud.points_m,
        intensity=cloud.intensity,
        ring=cloud.ring,
        time_s=(turn_s * share).astype(np.float32),
        kind=nothing,
        instance=nothing.astype(np.uint16),
        material=nothing,
    )


class _Film:
    """Images of all cameras; the light of a board that is held is the same all the time."""

    def __init__(self, session: BoardSession) -> None:
        self._session = session
        self._held: dict[str, tuple[int, F4]] = {}

    def light(self, camera: str, now: Moment) -> F4:
        held = self._held.get(camera)
        if now.held and held is not None and held[0] == now.stand:
            return held[1]
        light = self._session.light(camera, now.stand, now.T_lidar_board)
        if now.held:
            self._held[camera] = (now.stand, light)
        return light


def _images(session: BoardSession, timing: Timing) -> Iterator[Entry]:
    film = _Film(session)
    for n in range(int(duration_s(session, timing) / timing.image_s + _WHOLE) + 1):
        time_s = n * timing.image_s
        stamp_ns, now = _START_NS + round(time_s * 1e9), moment(session, timing, time_s)
        for index, camera in enumerate(session.given):
            rng = np.random.default_rng((session.seed, 77, n, index))
            image = session.image_of(film.light(camera.name, now), camera.name, not now.held, rng)
            yield from _messages(camera, image, stamp_ns)


def _messages(camera: Camera, image: NDArray[np.uint8], stamp_ns: int) -> Iterator[Entry]:
    head = header(stamp_ns, camera.name)
    message = class_of(IMAGE)(header=head, format="png", data=np.frombuffer(png(image), np.uint8))
    received = stamp_ns + _IMAGE_DELAY_NS
    yield received, image_topic(camera.name), stamp_ns, serialised(IMAGE, message)
    info = lens_message(camera.model, head)
    yield received, info_topic(camera.name), stamp_ns, serialised(INFO, info)
