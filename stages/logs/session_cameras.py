"""Cameras in a session file: `calibration` and `cameras` become settings of `images`, so that their content counts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from scanloom.schemas.cameras import Camera
from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.logs.camera_files import Entry, pick, read_camera_file
from scanloom.stages.logs.camera_options import GivenCamera
from scanloom.stages.logs.mounting import as_matrix4, pose_of_numbers


def _flat(value: object) -> object:
    """A 4x4 matrix as 16 numbers."""
    if isinstance(value, list | tuple) and all(isinstance(row, list | tuple) for row in value):
        value = [number for row in value for number in row]
    if isinstance(value, list | tuple) and len(value) not in (6, 16):
        raise ValueError("give 6 numbers (x, y, z in m, roll, pitch, yaw in rad) or a 4x4 matrix")
    return value


class CameraEntry(BaseModel):
    """A camera: its topic (`none` leaves it out), its model from a file, its pose on the LiDAR, its clock."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    topic: str = ""
    model: str = ""
    """A Kalibr camchain, an OpenCV or ROS calibration, or a calibration.json; `FILE#NAME` names a camera in it."""
    T_lidar_camera: Annotated[tuple[float, ...] | None, BeforeValidator(_flat)] = None
    """Camera axes: x right, y down, z forward. 6 numbers (x, y, z in m, roll, pitch, yaw in rad) or a 4x4 matrix."""
    clock_offset_s: float | None = None
    """How much later its stamps are than the LiDAR's clock."""
    readout_s: float | None = None
    """Of a rolling shutter, from the first row to the last."""


def given_cameras(
    calibration: str, cameras: Mapping[str, CameraEntry], folder: Path, where: Path
) -> dict[str, Any]:
    """Settings of `images`; none where the session file says nothing of cameras.

    Parameters
    ----------
    calibration : file with all cameras of the rig; empty for none.
    cameras : what is said of each by itself; it stands over the calibration.
    folder : to which names of files are relative.
    where : the session file, for messages.

    Raises
    ------
    InvalidInput : a file is not there or describes no such camera.
    UsageError : a value makes no sense.
    """
    rig = _rig(folder / calibration) if calibration else {}
    given = []
    for name in dict.fromkeys((*rig, *cameras)):
        asked = cameras.get(name, CameraEntry())
        try:
            given.append(_given(name, asked, rig.get(name), folder))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"])
            text = first["msg"].removeprefix("Value error, ")
            raise UsageError(
                f"cameras.{name}.{place}: {text}", where=str(where), next_step="correct the session file"
            ) from error
    return {"cameras": [g.model_dump(mode="json", exclude_defaults=True) for g in given]} if given else {}


def _rig(path: Path) -> dict[str, Entry]:
    rig = {entry.camera.name: entry for entry in read_camera_file(path)}
    if "" in rig:
        raise InvalidInput(
            "The calibration does not name its camera.",
            where=str(path),
            next_step=f"say which one it is: cameras: {{NAME: {{model: {path.name}}}}}",
        )
    return rig


def _given(name: str, asked: CameraEntry, entry: Entry | None, folder: Path) -> GivenCamera:
    """One camera: what is said of it by itself over what its file says."""
    if asked.model:
        file, _, wanted = asked.model.partition("#")
        path = folder / file
        entry = pick(read_camera_file(path), wanted, name, asked.topic, str(path))
    told: dict[str, Any] = {} if entry is None else _of_file(entry.camera)
    if entry is not None:
        told["remark"] = entry.remark
    told |= {"name": name, "topic": asked.topic}
    if asked.T_lidar_camera is not None:
        told |= {"T_lidar_camera": as_matrix4(pose_of_numbers(asked.T_lidar_camera)), "remark": ""}
    for key in ("clock_offset_s", "readout_s"):
        value = getattr(asked, key)
        if value is not None:
            told[key] = value
    return GivenCamera.model_validate(told)


def _of_file(camera: Camera) -> dict[str, Any]:
    names = ("model", "T_lidar_camera", "clock_offset_s", "readout_s")
    return {name: getattr(camera, name) for name in names} | {"source": camera.source or "session file"}
