"""`calibrate`: cameras to a LiDAR from boards; everything is written at the end, or nothing."""

from __future__ import annotations

import io
import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from scanloom.schemas.calibration import Calibration
from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.calibration import Found, calibrate
from scanloom.stages.calibrate.cloud import CloudBoard, CloudSettings, Search, search_boards, static_points
from scanloom.stages.calibrate.document import Row, document, metrics
from scanloom.stages.calibrate.exports import exports, roll_pitch_yaw
from scanloom.stages.calibrate.image import ImageBoard, find_corners, pattern_seen
from scanloom.stages.calibrate.pictures import picture
from scanloom.stages.calibrate.scene import Placement, Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.calibrate.standstill import StandstillSettings
from scanloom.stages.calibrate.view import LidarView
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.logs import camera_options, options
from scanloom.workflows.calibration_folder import (
    CalibrationSession,
    PointCloud,
    Shown,
    read_image,
    read_session,
)
from scanloom.workflows.calibration_log import LogSettings, read_log
from scanloom.workflows.configuration import Overrides

log = logging.getLogger("scanloom.calibrate")
_LEAST_CLOUDS = 4
"""Clouds from which a background can be told from the board."""
_PROBED = 4
_MOST_BOARDS = 4
"""Boards of one cloud that are tried."""
_SETTINGS: dict[str, type[BaseModel]] = {
    "calibrate": CalibrateSettings,
    "cloud": CloudSettings,
    "standstill": StandstillSettings,
    "ingest": options.Settings,
    "images": camera_options.Settings,
}
SettingsT = TypeVar("SettingsT", bound=BaseModel)


@dataclass(frozen=True)
class Order:
    """What is to be calibrated and how."""

    session: Path
    out: Path
    board: Path | None = None
    calibrate: CalibrateSettings = CalibrateSettings()
    cloud: CloudSettings = CloudSettings()
    pictures: bool = True
    log: LogSettings = LogSettings()


@dataclass(frozen=True)
class Outcome:
    """What was written."""

    out: Path
    calibration: Calibration
    metrics: list[Row]
    files: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """For `--json`."""
        return {
            "out": str(self.out),
            "calibration": self.calibration.model_dump(mode="json"),
            "metrics": self.metrics,
            "files": list(self.files),
        }


@dataclass(frozen=True)
class Looked:
    """What was found in the files of a session."""

    scene: Scene
    clouds: dict[str, PointCloud]
    unseen: dict[str, str]
    """Placements that cannot be used, and why."""


def text_of(outcome: Outcome) -> str:
    """A screen of text."""
    calibration = outcome.calibration
    lines = []
    for camera, c in zip(calibration.cameras, calibration.certainty, strict=True):
        T = np.array(camera.T_lidar_camera)
        turn = np.degrees(roll_pitch_yaw(T[:3, :3]))
        lines += [
            f"{camera.name}: {c.placements} placements",
            f"  camera in the LiDAR's frame   x y z {_three(T[:3, 3], 4)} m   roll pitch yaw {_three(turn, 3)} deg",
            f"  one sigma (camera's axes)     {_three(1e3 * np.array(c.translation_sigma_m), 1)} mm   "
            f"{_three(np.array(c.rotation_sigma_deg), 3)} deg",
            f"  placements left out           {c.leave_one_out_px:.2f} px   {c.leave_one_out_cm:.2f} cm",
            f"  known worst                   {c.weakest}",
            f"  would help                    {c.advice}",
        ]
    for r in calibration.repeatability:
        lines.append(
            f"{r.camera}: {r.halves} random halves within {r.rotation_max_deg:.3f} deg and {100 * r.translation_max_m:.2f} cm of "
            "their mean"
        )
    lines += [f"left out: {p.name}: {p.reason}" for p in calibration.placements if not p.used]
    lines += [f"note: {remark}" for remark in calibration.remarks]
    lines += [f"{calibration.verdict}: {calibration.reason}", f"written: {outcome.out / 'calibration.json'}"]
    return "\n".join(lines)


def _three(values: F8, digits: int) -> str:
    return " ".join(f"{v:.{digits}f}" for v in values)


def order_of(
    session: Path, out: Path, board: Path | None, overrides: Overrides, pictures: bool = True
) -> Order:
    """What is asked for, with settings as `--set calibrate.field=value`.

    Raises
    ------
    UsageError : an unknown name, or a value out of bounds.
    """
    unknown = sorted(set(overrides) - set(_SETTINGS))
    if unknown:
        raise UsageError(
            f"{unknown[0]!r} has no settings here", next_step=f"known are {', '.join(_SETTINGS)}"
        )

    def made(model: type[SettingsT]) -> SettingsT:
        name = next(name for name, other in _SETTINGS.items() if other is model)
        return _made(name, model, overrides.get(name, {}))

    log = LogSettings(made(options.Settings), made(camera_options.Settings), made(StandstillSettings))
    return Order(session, out, board, made(CalibrateSettings), made(CloudSettings), pictures, log)


def _made(name: str, model: type[SettingsT], values: dict[str, object]) -> SettingsT:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        at = ".".join(str(part) for part in first["loc"])
        raise UsageError(
            f"{name}.{at}: {first['msg']}", next_step=f"see `{name}` in docs/calibration.md"
        ) from error


def session_of(order: Order) -> CalibrationSession:
    """A folder of placements, or a log.

    Raises
    ------
    InvalidInput : it is neither.
    """
    if any((order.session / name).is_dir() for name in ("clouds", "images")):
        return read_session(order.session, order.board)
    return read_log(order.session, order.board, order.log)


def calibrate_rig(order: Order) -> Outcome:
    """Look at every file, calibrate, check, and write.

    Raises
    ------
    InvalidInput : the session cannot be calibrated; nothing was written then.
    """
    session = session_of(order)
    looked = look(session, order.cloud)
    given = {
        name: np.array(camera.T_lidar_camera)
        for name, camera in session.cameras.items()
        if camera.T_lidar_camera
    }
    try:
        found = calibrate(looked.scene, order.calibrate, given)
    except InvalidInput as error:
        raise _explained(error, session, looked) from error
    calibration = document(found, session.cameras, order.calibrate, looked.unseen)
    rows = metrics(found, calibration)
    files = _contents(order, session, looked, found, calibration, rows)
    for name, content in files.items():
        path = order.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    calibration.write(order.out / "calibration.json")
    return Outcome(order.out, calibration, rows, ("calibration.json", *files))


# --- what the files show ---------------------------------------------------------------------------------------------


def look(session: CalibrationSession, settings: CloudSettings) -> Looked:
    """Boards in all clouds and images.

    Raises
    ------
    InvalidInput : an image is not its camera's, or no cloud or no image shows the board.
    """
    images = {(p.name, c): _corners(session, p, c) for p in session.placements for c in p.cameras}
    if not any(images.values()):
        raise _no_pattern(session)
    clouds = {p.name: p.cloud() for p in session.placements}
    searches = search_clouds(clouds, session.board, settings)
    if not any(search.boards for search in searches.values()):
        raise _no_board(session, searches)
    placements, unseen = [], dict(session.unused)
    for p in session.placements:
        seen = {c: found for c in p.cameras if (found := images[p.name, c]) is not None}
        if not searches[p.name].boards:
            unseen[p.name] = "no board in the cloud" + _largest(searches[p.name])
        elif not seen:
            unseen[p.name] = "no board in the image"
        else:
            first, *more = (view_of(board) for board in searches[p.name].boards[:_MOST_BOARDS])
            placements.append(Placement(p.name, first, seen, tuple(more)))
    models = {name: camera.model for name, camera in session.cameras.items()}
    return Looked(Scene.of(session.board, models, tuple(placements)), clouds, unseen)


def view_of(board: CloudBoard) -> LidarView:
    """A board of a cloud as the graph takes it."""
    evidence = board.evidence
    return LidarView(
        board.T_lidar_board,
        evidence.beams,
        evidence.root,
        evidence.gap,
        len(board.points_m),
        len(board.edge_points_m),
    )


def search_clouds(clouds: dict[str, PointCloud], board: Board, settings: CloudSettings) -> dict[str, Search]:
    """Boards in clouds, against the background that most of them have in common."""
    background: F8 | None = None
    if len(clouds) >= _LEAST_CLOUDS:
        background = static_points([cloud.points_m for cloud in clouds.values()])
    found = {}
    for i, (name, cloud) in enumerate(clouds.items()):
        log.info("cloud %d of %d: %s", i + 1, len(clouds), name)
        found[name] = search_boards(cloud.points_m, cloud.intensity, cloud.ring, board, background, settings)
    return found


def _corners(session: CalibrationSession, p: Shown, camera: str) -> ImageBoard | None:
    chosen = session.cameras[camera]
    return find_corners(read_image(p, chosen), session.board, chosen.model)


def _largest(search: Search) -> str:
    return f" (the largest flat piece {search.refused[0].reason})" if search.refused else ""


def _no_pattern(session: CalibrationSession) -> InvalidInput:
    """No image shows the board: what do they show?"""
    m, n = session.board.inner_corners
    seen: Counter[tuple[int, int]] = Counter()
    for p in session.placements[:_PROBED]:
        for camera in p.cameras:
            size = pattern_seen(read_image(p, session.cameras[camera]))
            if size is not None:
                seen[size] += 1
    what = f"No image shows a board of {m} x {n} inner corners"
    if seen:
        (a, b), _ = seen.most_common(1)[0]
        return InvalidInput(
            f"{what}; they show one of {a} x {b}.",
            where=str(session.board_file),
            next_step=f"write inner_corners: [{a}, {b}], or give the file of this board with --board",
        )
    return InvalidInput(
        f"{what}, nor any other.",
        where=session.images,
        next_step="take images in which all squares of the board are seen, sharp and without glare",
    )


def _no_board(session: CalibrationSession, searches: dict[str, Search]) -> InvalidInput:
    a, b = session.board.board_m
    reasons = Counter(piece.reason for search in searches.values() for piece in search.refused[:1])
    common = (
        f"; the largest flat pieces: {'; '.join(reason for reason, _ in reasons.most_common(3))}"
        if reasons
        else ""
    )
    return InvalidInput(
        f"No cloud shows a board of {a} x {b} m{common}.",
        where=session.clouds,
        next_step=f"see board_m in {session.board_file}, and that the board stands free, 1 to 6 m away, across several beams",
    )


def _explained(error: InvalidInput, session: CalibrationSession, looked: Looked) -> InvalidInput:
    """The same error with the session's name and what could not be used."""
    lost = "; ".join(f"{name}: {reason}" for name, reason in looked.unseen.items())
    what = f"{error.what}. Not usable: {lost}." if lost else f"{error.what}."
    where = (
        str(session.board_file)
        if error.where == "board.yaml"
        else f"{session.path}, {error.where}".rstrip(", ")
    )
    return InvalidInput(what, where=where, next_step=error.next_step)


# --- what is written -------------------------------------------------------------------------------------------------


def _contents(
    order: Order,
    session: CalibrationSession,
    looked: Looked,
    found: Found,
    calibration: Calibration,
    rows: Sequence[Row],
) -> dict[str, bytes]:
    """Everything but `calibration.json`, by name."""
    files = {"metrics.json": (json.dumps(list(rows), indent=1) + "\n").encode()}
    files |= {f"exports/{name}": text.encode() for name, text in exports(calibration.cameras).items()}
    if order.pictures:
        for p in session.placements:
            files |= _pictures(session, looked, found, p)
    return files


def _pictures(session: CalibrationSession, looked: Looked, found: Found, p: Shown) -> dict[str, bytes]:
    placement = next((q for q in found.everything.placements if q.name == p.name), None)
    if placement is None:
        return {}
    cloud, made = looked.clouds[p.name], {}
    T_lidar_board = found.estimate.board_by_cloud(placement, found.noise)
    for camera, seen in placement.images.items():
        where = (p.name, camera)
        miss = found.checks.left_out.get(where)
        note = (
            f"{miss.px:.1f} px, {miss.cm:.2f} cm without it"
            if miss
            else f"left out: {found.left_out.get(where, '')}"
        )
        made[f"pictures/{p.name}_{camera}.png"] = picture(
            _colour(p.image(camera)),
            cloud.points_m,
            cloud.intensity,
            found.estimate.T_lidar_camera[camera],
            found.estimate.models[camera],
            session.board,
            T_lidar_board,
            seen.pixels,
            f"{p.name} {camera}: {note}",
        )
    return made


def _colour(data: bytes) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"))
