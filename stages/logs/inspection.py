"""What is in a log, what would be used, what is wrong with it, and the one next thing to do; decodes three scans only."""

from __future__ import annotations

import difflib
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from scanloom.schemas.errors import InvalidInput, ScanloomError, UsageError
from scanloom.schemas.session import Extrinsic, Problem, Session, Topic
from scanloom.stages.logs import camera_options
from scanloom.stages.logs.cameras import FoundCamera, find_cameras, mount_cameras
from scanloom.stages.logs.locate import Located, locate
from scanloom.stages.logs.options import Settings
from scanloom.stages.logs.reader import open_log
from scanloom.stages.logs.records import CloudFile, LivoxCloud, LogSource, PointCloud2
from scanloom.stages.logs.roles import ROLES, assign_roles, no_lidar
from scanloom.stages.logs.survey import Survey
from scanloom.stages.logs.sweeps import CloudMessage, ScanMaker

SettingsT = TypeVar("SettingsT", bound=BaseModel)
_LOOKED_AT = 3
_WEIGHT = {"error": 0, "warning": 1, "info": 2}
_MISSING = {
    "imu": "no IMU: motion within a sweep comes from the scans themselves",
    "gnss": "no GNSS: the map gets no georeference",
    "wheel": "no wheel speed: nothing helps where the scans see no structure along the road",
}


@dataclass(frozen=True)
class InspectedCamera:
    """A camera of the log and what is known of it."""

    name: str
    topic: str
    images: int
    width_px: int
    """Of its images; 0 when none can be read."""
    height_px: int
    lens: str
    """Empty when nothing tells it: the camera is not used then."""
    mounted: bool
    """Whether it is known where it sits on the LiDAR."""
    source: str
    """Where lens and mounting come from."""


@dataclass(frozen=True)
class Inspection:
    """The findings; `as_json` makes plain values of them."""

    path: str
    name: str
    format: str
    size_bytes: int
    files: int
    usable: bool
    """Whether `map` would start on it."""
    complete: bool
    duration_s: float
    start_ns: int
    end_ns: int
    scans: int
    points_per_scan: int
    beams: int
    point_time: str
    topics: tuple[Topic, ...]
    used: dict[str, str]
    """Topic by role."""
    missing: tuple[str, ...]
    extrinsics: tuple[Extrinsic, ...]
    cameras: tuple[InspectedCamera, ...]
    truth: tuple[str, ...]
    """Files with the true trajectory, for evaluation only."""
    problems: tuple[Problem, ...]
    next_step: str

    def as_json(self) -> dict[str, Any]:
        """Plain dictionaries, lists, numbers and texts."""
        plain = asdict(self)
        for name in ("topics", "extrinsics", "problems"):
            plain[name] = [entry.model_dump(mode="json") for entry in getattr(self, name)]
        return plain


def inspect_log(
    path: Path, settings: Settings | None = None, images: camera_options.Settings | None = None
) -> Inspection:
    """Look at a log without computing anything.

    Parameters
    ----------
    path : what the user calls a SESSION.
    settings : settings of ingest given by the user; those of a session file stand behind them.
    images : settings of images, likewise.

    Raises
    ------
    InvalidInput : it is no log at all.
    UsageError : the settings name a topic that the log does not have.
    """
    located = locate(path)
    merged = _merged("ingest", Settings, settings, located, str(path))
    of_images = _merged("images", camera_options.Settings, images, located, str(path))
    source = open_log(located.raw_log, merged.scan_rate_hz)
    survey, session, error, used = _look(source, merged, str(path))
    seen = find_cameras(source, of_images)
    mount_cameras(seen, survey.tf, survey.tracks["lidar"].frame)
    sizes = [(located.raw_log.root or Path()) / name for name in located.raw_log.names]
    problems = [*session.problems, *map(_camera_problem, seen.remarks)]
    if error is not None:
        problems.append(_as_problem(error))
    return Inspection(
        path=str(path),
        name=located.name,
        format=located.format,
        size_bytes=sum(file.stat().st_size for file in sizes),
        files=len(sizes),
        usable=error is None,
        complete=session.complete,
        duration_s=session.duration_s,
        start_ns=session.start_ns,
        end_ns=session.end_ns,
        scans=session.scan_count,
        points_per_scan=session.point_count,
        beams=session.beams,
        point_time=session.point_time,
        topics=session.topics,
        used=used,
        missing=tuple(_MISSING[role] for role in _MISSING if role not in used) if "lidar" in used else (),
        extrinsics=session.extrinsics,
        cameras=tuple(map(_inspected, seen.found)),
        truth=located.truth_log.names,
        problems=tuple(sorted(problems, key=lambda problem: _WEIGHT[problem.severity])),
        next_step=_next_step(path, session, error),
    )


def _merged(
    stage: str, model: type[SettingsT], given: SettingsT | None, located: Located, where: str
) -> SettingsT:
    """The user's settings over those of the session file."""
    values = {**located.settings.get(stage, {}), **(given or model()).model_dump(exclude_unset=True)}
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        near = difflib.get_close_matches(name, model.model_fields, 1, 0.4)
        hint = f"did you mean {stage}.{near[0]}?" if near and near[0] != name else "correct the session file"
        raise UsageError(f"{stage}.{name}: {first['msg']}", where=where, next_step=hint) from error


def _look(
    source: LogSource, settings: Settings, where: str
) -> tuple[Survey, Session, ScanloomError | None, dict[str, str]]:
    """The session as ingest would find it, with points counted per scan; the error that ingest would raise."""
    roles = assign_roles(source, settings.wanted_topics())
    survey = Survey(source, roles, settings)
    maker = ScanMaker(settings, roles.lidar, survey.period_ns())
    clouds: list[CloudMessage] = []
    for message in source.messages(survey.topics):
        survey.note(message)
        wanted = message.topic == roles.lidar and len(clouds) < _LOOKED_AT
        if wanted and isinstance(message.body, PointCloud2 | LivoxCloud | CloudFile):
            clouds.append(message.body)
    readable = len(list(islice(maker.ordered(iter(clouds)), _LOOKED_AT)))
    tally = maker.finish()
    tally.points = tally.points // max(readable, 1)
    stamps = survey.tracks["lidar"].header_ns
    tally.scans = len(stamps) if readable else 0
    if stamps:
        tally.last_ns = max(tally.last_ns, max(stamps))
    used = {role: roles.of(role) for role in ROLES if roles.of(role)}
    error: InvalidInput | None = None
    if not roles.lidar:
        error = no_lidar(source, where)
        tally.first_ns, tally.last_ns = _span(source)
    elif readable < 2:
        error = InvalidInput(
            f"The log holds {readable} readable scan{'s' * (readable != 1)}; a map needs at least two.",
            where=where,
        )
    return survey, survey.session("", tally, survey.imu(), survey.gnss()), error, used


def _inspected(camera: FoundCamera) -> InspectedCamera:
    width, height = camera.size_px or (0, 0)
    return InspectedCamera(
        name=camera.name,
        topic=camera.topic,
        images=camera.images,
        width_px=width,
        height_px=height,
        lens=camera.model.lens if camera.model else "",
        mounted=camera.T_lidar_camera is not None,
        source=", ".join(dict.fromkeys(filter(None, (camera.source, camera.pose_source)))),
    )


def _camera_problem(remark: str) -> Problem:
    return Problem(code="camera.remark", severity="warning", text=remark)


def _span(source: LogSource) -> tuple[int, int]:
    found = [topic for topic in source.topics if topic.count]
    return min((t.first_ns for t in found), default=0), max((t.last_ns for t in found), default=0)


def _as_problem(error: ScanloomError) -> Problem:
    return Problem(code="log.unusable", severity="error", text=error.what)


def _next_step(path: Path, session: Session, error: ScanloomError | None) -> str:
    """The one thing to do next."""
    if error is not None:
        advice = error.next_step or "give another log"
        return f"{advice[0].upper()}{advice[1:]}."
    if not session.complete:
        return f"Copy the log again if the original is whole; else map what there is: scanloom map {path}"
    for problem in session.problems:
        if problem.severity == "warning" and problem.code in _ADVICE:
            return f"{_ADVICE[problem.code]} Then: scanloom map {path}"
    return f"scanloom map {path}"


_ADVICE = {
    "lidar.ambiguous": "Choose the LiDAR with ingest.lidar_topic.",
    "imu.no_overlap": "Bring the clocks together with ingest.imu_offset_s, or leave the IMU out (ingest.imu_topic=none).",
    "imu.gravity": "Leave the IMU out (ingest.imu_topic=none).",
    "imu.gyro_unit": "Check the unit of the gyro; leave the IMU out (ingest.imu_topic=none) if it is in degrees.",
    "imu.gravity_axis": "Give the IMU's mounting with ingest.imu_on_base.",
    "extrinsics.assumed": "Give the sensors' mounting if they are not close to the LiDAR.",
}
