"""Cameras of KITTI folders: raw drives (rectified or not) and odometry sequences.

Source: Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and the readme of its
development kit: `x = P_rect_i R_rect_00 T_velo_to_cam X` in rectified images.
"""

from __future__ import annotations

import re
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.schemas.session import Problem, RawLog
from scanloom.stages.geometry.se3 import F8, inverse, pose
from scanloom.stages.logs.folder import problem
from scanloom.stages.logs.lenses import camera_model
from scanloom.stages.logs.mounting import as_matrix4
from scanloom.stages.logs.oxts import read_calibration, read_timestamps
from scanloom.stages.logs.records import ImageFile

Numbers = dict[str, NDArray[np.float64]]
_RAW = re.compile(r"(?P<drive>.*/|)(?P<camera>image_0[0-3])/data/(?P<number>\d+)\.(png|jpg)$")
_ODOMETRY = re.compile(r"(?P<drive>.*/|)(?P<camera>image_[0-3])/(?P<number>\d+)\.(png|jpg)$")
_SOURCE = "kitti calibration"


def raw_images(log: RawLog, drive: str, problems: list[Problem]) -> dict[str, list[ImageFile]]:
    """Images of a raw drive by camera (`image_00`, ...); each camera has stamps of its own."""
    found: dict[str, list[ImageFile]] = {}
    for camera, files in _files(log, _RAW, drive).items():
        times = read_timestamps(log, f"{drive}{camera}/timestamps.txt", problems)
        if not times:
            text = f"{camera}/timestamps.txt is missing; its {len(files)} images are left out"
            problems.append(problem("kitti.images_without_time", "warning", text, camera))
        found[camera] = _stamped(log, files, times)
    return found


def odometry_images(log: RawLog, drive: str, times: dict[int, int]) -> dict[str, list[ImageFile]]:
    """Images of an odometry sequence by camera (`image_0`, ...), which share their stamps with the scans."""
    return {camera: _stamped(log, files, times) for camera, files in _files(log, _ODOMETRY, drive).items()}


def raw_cameras(
    log: RawLog, images: dict[str, list[ImageFile]], problems: list[Problem]
) -> tuple[Camera, ...]:
    """Models and mounting from `calib_cam_to_cam.txt` and `calib_velo_to_cam.txt`."""
    seen = [camera for camera, files in images.items() if files]
    if not seen:
        return ()
    lenses, mounting = _calibration(log, "calib_cam_to_cam.txt"), _calibration(log, "calib_velo_to_cam.txt")
    missing = [name for name, numbers in (("calib_cam_to_cam.txt", lenses), ("calib_velo_to_cam.txt", mounting)) if not numbers]  # fmt: skip
    if missing:
        text = f"{' and '.join(missing)} beside the drive would say how the cameras see and where they sit"
        problems.append(problem("kitti.camera_calibration", "warning", text))
    T_cam0_velo = pose(mounting["R"].reshape(3, 3), mounting["T"]) if _whole(mounting, R=9, T=3) else None
    rectified = not any("_extract" in str(images[camera][0].path) for camera in seen)
    entries = [_raw_camera(camera, lenses, T_cam0_velo, rectified=rectified) for camera in seen]
    return tuple(entry for entry in entries if entry is not None)


def odometry_cameras(log: RawLog, images: dict[str, list[ImageFile]]) -> tuple[Camera, ...]:
    """Models and mounting from `calib.txt`: `P0` to `P3` and `Tr`, of rectified images; sizes are the images'."""
    numbers = _calibration(log, "calib.txt")
    cameras = []
    for camera, files in images.items():
        P = numbers.get(f"P{camera[-1]}")
        size = _size(files)
        if P is None or len(P) != 12 or size is None:
            continue
        T = _T_lidar_camera(P, pose_of(numbers["Tr"])) if len(numbers.get("Tr", ())) == 12 else None
        model = _pinhole(P, size)
        if model is not None:
            cameras.append(Camera(name=camera, model=model, T_lidar_camera=as_matrix4(T), source=_SOURCE))
    return tuple(cameras)


def pose_of(rows: F8) -> F8:
    """The 4 by 4 of 12 numbers, row by row."""
    return np.vstack((np.reshape(rows, (3, 4)), (0.0, 0.0, 0.0, 1.0)))


def _raw_camera(camera: str, lenses: Numbers, T_cam0_velo: F8 | None, *, rectified: bool) -> Camera | None:
    number = camera[-2:]
    T: F8 | None = None
    model: CameraModel | None
    if rectified:
        if not _whole(lenses, **{f"P_rect_{number}": 12, f"S_rect_{number}": 2, "R_rect_00": 9}):
            return None
        P, size = lenses[f"P_rect_{number}"], lenses[f"S_rect_{number}"]
        model = _pinhole(P, (round(size[0]), round(size[1])))
        if T_cam0_velo is not None:
            straight = pose(lenses["R_rect_00"].reshape(3, 3), np.zeros(3))
            T = _T_lidar_camera(P, straight @ T_cam0_velo)
    else:
        if not _whole(
            lenses,
            **{f"K_{number}": 9, f"D_{number}": 5, f"S_{number}": 2, f"R_{number}": 9, f"T_{number}": 3},
        ):
            return None
        size = lenses[f"S_{number}"]
        model = _model("plumb_bob", lenses[f"K_{number}"].reshape(3, 3), lenses[f"D_{number}"], size)
        if T_cam0_velo is not None:
            T = inverse(pose(lenses[f"R_{number}"].reshape(3, 3), lenses[f"T_{number}"]) @ T_cam0_velo)
    if model is None:
        return None
    return Camera(name=camera, model=model, T_lidar_camera=as_matrix4(T), source=_SOURCE)


def _T_lidar_camera(P: F8, T_rect_lidar: F8) -> F8:
    """`P = K [1 | t]`: the camera's axes are those of the rectified camera 0, its origin stands at -t."""
    P = P.reshape(3, 4)
    T = np.eye(4)
    T[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    return inverse(T @ T_rect_lidar)


def _pinhole(P: F8, size: tuple[int, int]) -> CameraModel | None:
    return _model("none", P.reshape(3, 4)[:, :3], (), size)


def _model(name: str, K: F8, distortion: object, size: object) -> CameraModel | None:
    width, height = (round(float(side)) for side in np.ravel(np.asarray(size, float)))
    try:
        return camera_model(
            name, K, [float(d) for d in np.ravel(np.asarray(distortion, float))], (width, height)
        )
    except ValueError:
        return None


def _size(files: list[ImageFile]) -> tuple[int, int] | None:
    from PIL import Image as Picture

    for file in files[:3]:
        try:
            with Picture.open(file.path) as picture:
                return picture.width, picture.height
        except OSError:
            continue
    return None


def _calibration(log: RawLog, name: str) -> Numbers:
    path = next((entry for entry in log.names if PurePosixPath(entry).name == name), "")
    return read_calibration(log.path(path)) if path else {}


def _whole(numbers: Numbers, **lengths: int) -> bool:
    return all(len(numbers.get(name, ())) == length for name, length in lengths.items())


def _files(log: RawLog, pattern: re.Pattern[str], drive: str) -> dict[str, dict[int, str]]:
    found: dict[str, dict[int, str]] = {}
    for name in log.names:
        match = pattern.match(name)
        if match and match["drive"] == drive:
            found.setdefault(match["camera"], {})[int(match["number"])] = name
    return dict(sorted(found.items()))


def _stamped(log: RawLog, files: dict[int, str], times: dict[int, int]) -> list[ImageFile]:
    return [
        ImageFile(times[number], times[number], log.path(name))
        for number, name in sorted(files.items())
        if number in times
    ]
