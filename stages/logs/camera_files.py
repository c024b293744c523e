"""Camera models from files: Kalibr camchains, OpenCV and ROS calibrations, and `calibration.json`.

Kalibr: https://github.com/ethz-asl/kalibr/wiki/yaml-formats; ROS: `camera_calibration_parsers` (YAML).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.schemas.errors import InvalidInput
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.logs.lenses import camera_model
from scanloom.stages.logs.mounting import as_matrix4

_MAX_BYTES = 16 << 20
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "K", "M1")
_DISTORTION = (
    "distortion_coefficients",
    "distCoeffs",
    "dist_coeffs",
    "Distortion_Coefficients",
    "distortion",
    "D",
    "D1",
)
_WIDTH = ("image_width", "width", "image_Width", "imageWidth")
_HEIGHT = ("image_height", "height", "image_Height", "imageHeight")
_FORMATS = "a Kalibr camchain, an OpenCV or ROS camera calibration (YAML), or a calibration.json"


@dataclass(frozen=True)
class Entry:
    """A camera of a file."""

    camera: Camera
    topic: str = ""
    remark: str = ""
    """What the file says of its place that is of no use alone."""


def read_camera_file(path: Path) -> list[Entry]:
    """Every camera that a file describes, by the name it has there (empty where it has none).

    Raises
    ------
    InvalidInput : the file is not there, is none of the known kinds, or a camera in it makes no sense.
    """
    content = _content(path)
    try:
        if "cameras" in content:
            return _calibration(content)
        chain = {name: entry for name, entry in content.items() if _is_kalibr(entry)}
        if chain:
            return _kalibr(chain)
        if any(name in content for name in _MATRIX):
            return [Entry(_opencv(content))]
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise _useless(path, f"{place}: {first['msg'].removeprefix('Value error, ')}") from error
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise _useless(path, str(error) or "a number is missing") from error
    raise InvalidInput("The file describes no camera.", where=str(path), next_step=f"give {_FORMATS}")


def pick(entries: list[Entry], wanted: str, name: str, topic: str, where: str) -> Entry:
    """The entry that is meant: the one asked for, of the camera's name, of its topic, or the only one.

    Raises
    ------
    InvalidInput : none of them, or several, may be meant.
    """
    for matches in (
        [e for e in entries if wanted and e.camera.name == wanted],
        [e for e in entries if not wanted and e.camera.name == name],
        [e for e in entries if not wanted and topic and e.topic == topic],
        [] if wanted else entries,
    ):
        if len(matches) == 1:
            return matches[0]
    names = ", ".join(e.camera.name for e in entries)
    asked = f"no camera {wanted}" if wanted else f"{len(entries)} cameras, none of them called {name}"
    raise InvalidInput(
        f"The file holds {asked}; it has {names}.", where=where,
        next_step=f"write which is meant after the file's name, for instance {Path(where).name}#{entries[0].camera.name}",
    )  # fmt: skip


def _useless(path: Path, reason: str) -> InvalidInput:
    return InvalidInput(f"The camera file cannot be used: {reason}.", where=str(path), next_step="correct it")


def _content(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InvalidInput(
                "The file is too large for a camera file.", where=str(path), next_step=f"give {_FORMATS}"
            )
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() == ".json":
            content = json.loads(text)
        else:
            # OpenCV writes "%YAML:1.0", which is no directive of YAML
            lines = [line for line in text.splitlines() if not line.startswith("%YAML:")]
            content = yaml.load("\n".join(lines), Loader=_Loader)
    except (OSError, UnicodeDecodeError, ValueError, yaml.YAMLError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
        raise InvalidInput(
            f"The camera file cannot be read: {reason}.", where=str(path), next_step=f"give {_FORMATS}"
        ) from error
    if not isinstance(content, dict):
        raise InvalidInput("The file describes no camera.", where=str(path), next_step=f"give {_FORMATS}")
    return content


class _Loader(yaml.SafeLoader):
    """Plain YAML, and OpenCV's matrices as mappings."""


def _mapping(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _mapping)


# --- calibration.json ------------------------------------------------------------------------------------------------


def _calibration(content: dict[str, Any]) -> list[Entry]:
    """The cameras of a calibration; what else it says is not needed here."""
    if not isinstance(content["cameras"], list) or not content["cameras"]:
        raise ValueError("it holds no camera")
    cameras = [Camera.model_validate(entry) for entry in content["cameras"]]
    doubt = str(content.get("reason", "")) if content.get("verdict") == "doubtful" else ""
    remark = f"The calibration is doubtful: {doubt}" if doubt else ""
    return [
        Entry(camera.model_copy(update={"source": camera.source or "calibration"}), remark=remark)
        for camera in cameras
    ]


# --- Kalibr ----------------------------------------------------------------------------------------------------------


def _is_kalibr(entry: object) -> bool:
    return isinstance(entry, dict) and "camera_model" in entry and "intrinsics" in entry


def _kalibr(chain: dict[str, dict[str, Any]]) -> list[Entry]:
    """Cameras in the order of the chain; each may stand on the one before it (`T_cn_cnm1`)."""
    entries: list[Entry] = []
    T_above: F8 | None = None
    for name, entry in chain.items():
        T_above = _on_lidar(name, entry, T_above)
        T = None if T_above is None else as_matrix4(inverse(T_above))
        camera = Camera(
            name=name, model=_kalibr_model(name, entry), T_lidar_camera=T, source="kalibr",
        )  # fmt: skip
        entries.append(Entry(camera, str(entry.get("rostopic", "")), _kalibr_remark(name, entry, T_above)))
    return entries


def _kalibr_model(name: str, entry: dict[str, Any]) -> CameraModel:
    kind, lens = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
    if kind != "pinhole":
        raise ValueError(
            f"{name} is of camera model {kind!r}; calibrate it as pinhole with radtan or equidistant"
        )
    fx, fy, cx, cy = (float(v) for v in entry["intrinsics"])
    if "resolution" not in entry:
        raise ValueError(f"{name} has no resolution; add `resolution: [width, height]`")
    width, height = (int(v) for v in entry["resolution"])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    try:
        return camera_model(
            lens, K, [float(d) for d in entry.get("distortion_coeffs") or ()], (width, height)
        )
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _on_lidar(name: str, entry: dict[str, Any], T_above_lidar: F8 | None) -> F8 | None:
    """T_camera_lidar: told, or from the camera before it."""
    if "T_cam_lidar" in entry:
        return _matrix(name, "T_cam_lidar", entry)
    if "T_cn_cnm1" in entry and T_above_lidar is not None:
        return np.asarray(_matrix(name, "T_cn_cnm1", entry) @ T_above_lidar)
    return None


def _matrix(name: str, key: str, entry: dict[str, Any]) -> F8:
    T = np.array(entry[key], float)
    if T.shape != (4, 4):
        raise ValueError(f"{key} of {name} is no 4x4 matrix")
    return T


def _kalibr_remark(name: str, entry: dict[str, Any], T: F8 | None) -> str:
    told = [key for key in ("T_cn_cnm1", "T_cam_imu") if key in entry]
    if T is not None or not told:
        return ""
    return f"{' and '.join(told)} of {name} alone do not say where it sits on the LiDAR; T_cam_lidar would."


# --- OpenCV and ROS --------------------------------------------------------------------------------------------------


def _opencv(content: dict[str, Any]) -> Camera:
    K = _numbers(_first(content, _MATRIX)).reshape(3, 3)
    distortion = _first(content, _DISTORTION)
    size = (_whole(content, _WIDTH, 0), _whole(content, _HEIGHT, 1))
    fisheye = bool(content.get("fisheye_model"))
    lens = "fisheye" if fisheye else str(content.get("distortion_model") or content.get("camera_model") or "")
    D = () if distortion is None else _numbers(distortion).tolist()
    name = str(content.get("camera_name") or "")
    model = camera_model("" if lens == "pinhole" else lens, K, D, size)
    return Camera(name=name, model=model, source="opencv")


def _first(content: dict[str, Any], names: tuple[str, ...]) -> Any:
    return next((content[name] for name in names if name in content), None)


def _numbers(value: Any) -> F8:
    return np.ravel(np.array(value["data"] if isinstance(value, dict) else value, float))


def _whole(content: dict[str, Any], names: tuple[str, ...], side: int) -> int:
    value = _first(content, names)
    if value is None:
        both = _first(content, ("image_size", "resolution", "imageSize"))
        value = _numbers(both)[side] if both is not None else 0
    return int(value)
