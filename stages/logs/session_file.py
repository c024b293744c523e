"""`session.yaml`: names a log, its topics, the sensors' mounting, the truth, and settings.

log: drive_07.mcap            # or a folder, or a list of bags; relative to this file
name: drive_07
topics: {lidar: /ouster/points, imu: /imu/data, wheel: none}
extrinsics: {lidar: [0.9, 0, 1.7, 0, 0, 0]}      # x, y, z (m), roll, pitch, yaw (rad), or 16 numbers
calibration: calibration.json                    # cameras as `scanloom calibrate` writes them
cameras:                                         # what the log and the calibration do not say of cameras
  front: {topic: /cam_front/image_raw, model: kalibr.yaml, T_lidar_camera: [0.9, 0, -0.4, -1.57, 0, -1.57], clock_offset_s: 0.02}
  rear: {topic: none}                            # left out
truth: {file: truth.tum, poses_of: lidar}        # or just the file: TUM or KITTI poses
settings: {odometry: {voxel_size_m: 0.4}}
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.stages.logs.formats import detect
from scanloom.stages.logs.locate import Located, check_file, locate
from scanloom.stages.logs.session_cameras import CameraEntry, given_cameras

_BESIDE_POSES = ("times.txt", "calib.txt")
_MAX_BYTES = 1 << 20


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Topics(_Part):
    """Topic of each sensor; `none` leaves one out."""

    lidar: str = ""
    imu: str = ""
    gnss: str = ""
    wheel: str = ""


class Extrinsics(_Part):
    """Pose of each sensor on the base: x, y, z (m), roll, pitch, yaw (rad), or a 4x4 matrix row by row."""

    lidar: tuple[float, ...] | None = None
    imu: tuple[float, ...] | None = None
    gnss: tuple[float, ...] | None = None
    wheel: tuple[float, ...] | None = None


class TruthFile(_Part):
    """The true trajectory and what it is of; the rest as in the settings of the stage `truth`."""

    file: str
    poses_of: Literal["lidar", "camera", "sensor"] = "lidar"
    time_offset_s: float = 0.0


class SessionFile(_Part):
    """The whole file."""

    log: str | list[str]
    name: str = ""
    topics: Topics = Topics()
    extrinsics: Extrinsics = Extrinsics()
    calibration: str = ""
    cameras: dict[str, CameraEntry] = {}
    truth: str | TruthFile | None = None
    settings: dict[str, dict[str, Any]] = {}


def read_session_file(path: Path) -> Located:
    """The session that a session file describes; paths in it are relative to it.

    Raises
    ------
    InvalidInput : the file is no YAML, or names a log or truth that is not there.
    UsageError : an unknown key (the nearest known one is named), or a value that does not fit.
    """
    session = _parse(path)
    folder = path.resolve().parent
    log = _log(session, folder, path)
    truth, truth_settings = _truth(session, folder, log)
    name = session.name or (folder.name if path.stem == "session" else path.stem)
    cameras = given_cameras(session.calibration, session.cameras, folder, path)
    settings = _settings(session, log, {"truth": truth_settings, "images": cameras})
    return Located(name, log.format, log.raw_log, truth, settings)


def _parse(path: Path) -> SessionFile:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InvalidInput("The file is too large for a session file.", where=str(path))
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidInput(
            f"The session file cannot be read: {str(error).splitlines()[0]}.",
            where=str(path),
            next_step="correct it",
        ) from error
    if not isinstance(content, dict) or "log" not in content:
        raise InvalidInput(
            "The session file names no log.",
            where=str(path),
            next_step="add a line `log: FILE`, relative to this file",
        )
    try:
        return SessionFile.model_validate(content)
    except ValidationError as error:
        raise _explained(error, path) from error


def _explained(error: ValidationError, path: Path) -> UsageError:
    first = error.errors()[0]
    keys = [str(part) for part in first["loc"]]
    if first["type"] != "extra_forbidden":
        return UsageError(
            f"{'.'.join(keys)}: {first['msg']}", where=str(path), next_step="correct the session file"
        )
    parents: dict[str, type[BaseModel]] = {
        "topics": Topics, "extrinsics": Extrinsics, "truth": TruthFile, "cameras": CameraEntry
    }  # fmt: skip
    known = list((parents.get(keys[0], SessionFile) if len(keys) > 1 else SessionFile).model_fields)
    near = difflib.get_close_matches(keys[-1], known, 1, 0.4)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
    return UsageError(
        f"The session file has an unknown key: {'.'.join(keys)}.", where=str(path), next_step=hint
    )


def _log(session: SessionFile, folder: Path, path: Path) -> Located:
    names = [session.log] if isinstance(session.log, str) else session.log
    paths = [folder / name for name in names]
    if not paths or any(p.resolve() in (path.resolve(), folder) for p in paths):
        raise InvalidInput(
            "The session file names itself as its log.", where=str(path), next_step="name the bag"
        )
    if len(paths) == 1:
        return locate(paths[0])
    for bag in paths:
        if not bag.is_file():
            raise InvalidInput(
                "There is no such file.", where=str(bag), next_step="correct `log` in the session file"
            )
        check_file(bag)
    root = Path(os.path.commonpath([p.resolve().parent for p in paths]))
    inside = tuple(p.resolve().relative_to(root).as_posix() for p in paths)
    return Located(session.name, detect(inside), RawLog(root, inside))


def _truth(session: SessionFile, folder: Path, log: Located) -> tuple[TruthLog, dict[str, Any]]:
    if session.truth is None:
        return log.truth_log, {}
    given = TruthFile(file=session.truth) if isinstance(session.truth, str) else session.truth
    file = folder / given.file
    if file.is_dir():
        names = tuple(sorted(p.relative_to(file).as_posix() for p in file.rglob("*") if p.is_file()))
        return TruthLog(file.resolve(), names), _truth_settings(given)
    if not file.is_file():
        raise InvalidInput("There is no such file with truth.", where=str(file), next_step="correct `truth`")
    beside = tuple(name for name in _BESIDE_POSES if (file.parent / name).is_file() and name != file.name)
    return TruthLog(file.resolve().parent, (file.name, *beside)), _truth_settings(given)


def _truth_settings(given: TruthFile) -> dict[str, Any]:
    return given.model_dump(exclude={"file"}, exclude_defaults=True)


def _settings(
    session: SessionFile, log: Located, others: dict[str, dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    ingest: dict[str, Any] = {
        f"{role}_topic": topic for role, topic in session.topics.model_dump().items() if topic
    }
    for sensor, values in session.extrinsics.model_dump().items():
        if values is not None:
            ingest[f"{sensor}_on_base"] = list(values)
    merged = {stage: dict(values) for stage, values in log.settings.items()}
    for extra in ({"ingest": ingest}, others, session.settings):
        for stage, values in extra.items():
            if values:
                merged.setdefault(stage, {}).update(values)
    return merged
