"""A calibration session: boards shown in several places; here from a folder of clouds and images of the same names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera
from scanloom.schemas.errors import InvalidInput
from scanloom.stages.calibrate.board import Board, read_board
from scanloom.stages.calibrate.image import grey
from scanloom.stages.logs.camera_files import read_camera_file
from scanloom.stages.logs.pointfiles import natural, read_points

CLOUDS = (".pcd", ".ply", ".bin")
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_LAYOUT = (
    "a folder with clouds/NAME.pcd, images/NAME.png, camera_info.yaml and board.yaml; for several cameras images/CAMERA/NAME.png "
    "and camera_info/CAMERA.yaml"
)


@dataclass(frozen=True)
class PointCloud:
    """A cloud as the sensor gave it, or several that were taken of the same."""

    points_m: NDArray[np.float64]
    intensity: NDArray[np.float64]
    ring: NDArray[np.int64] | None


class Shown(Protocol):
    """One placement of the board."""

    @property
    def name(self) -> str:
        """Unique in the session; usable as the name of a file."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras with an image of it."""

    def cloud(self) -> PointCloud:
        """What the LiDAR measured. Raises InvalidInput when it cannot be read."""

    def image(self, camera: str) -> bytes:
        """An encoded image. Raises InvalidInput when it cannot be read."""

    def where(self, camera: str) -> str:
        """Where the image is, for messages."""


@dataclass(frozen=True)
class PlacementFiles:
    """A placement in files."""

    name: str
    cloud_file: Path
    images: dict[str, Path]

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self.images)

    def cloud(self) -> PointCloud:
        return read_cloud(self.cloud_file)

    def image(self, camera: str) -> bytes:
        try:
            return self.images[camera].read_bytes()
        except OSError as error:
            raise InvalidInput(
                f"The image cannot be read: {error.strerror}.", where=self.where(camera)
            ) from error

    def where(self, camera: str) -> str:
        return str(self.images[camera])


@dataclass(frozen=True)
class CalibrationSession:
    """A rig that was shown a board."""

    path: Path
    board: Board
    board_file: Path
    cameras: dict[str, Camera]
    placements: tuple[Shown, ...]
    unused: dict[str, str]
    """Places that cannot be used, and why."""
    images: str
    """Where the images are, for messages."""
    clouds: str
    remarks: tuple[str, ...] = ()
    """What was odd about it, in sentences."""


def read_session(folder: Path, board: Path | None) -> CalibrationSession:
    """What a folder holds, by name; no cloud or image is decoded yet.

    Raises
    ------
    InvalidInput : it is no such folder, or its board or a camera file is missing or wrong.
    """
    if not (folder / "clouds").is_dir() or not (folder / "images").is_dir():
        raise InvalidInput("This is no calibration session.", where=str(folder), next_step=f"give {_LAYOUT}")
    board_file = board or folder / "board.yaml"
    cameras = _cameras(folder)
    clouds = _by_name(folder / "clouds", CLOUDS)
    images = {name: _by_name(where, IMAGES) for name, where in _image_folders(folder, cameras).items()}
    every = {name for found in images.values() for name in found}
    names = sorted(set(clouds) & every, key=natural)
    placements = tuple(
        PlacementFiles(name, clouds[name], {c: found[name] for c, found in images.items() if name in found})
        for name in names
    )
    if not placements:
        raise InvalidInput(
            "No image has the name of a cloud.", where=str(folder),
            next_step="name cloud and image of a placement alike, as clouds/pose1.pcd and images/pose1.png",
        )  # fmt: skip
    lacking = dict.fromkeys(sorted(set(clouds) ^ every, key=natural), "it has no image, or no cloud")
    return CalibrationSession(
        folder, read_board(board_file), board_file, cameras, placements, lacking,
        str(folder / "images"), str(folder / "clouds"),
    )  # fmt: skip


def _cameras(folder: Path) -> dict[str, Camera]:
    """One file for the one camera, or a folder with a file for each."""
    single = next((p for s in ("yaml", "yml", "json") if (p := folder / f"camera_info.{s}").is_file()), None)
    several = folder / "camera_info"
    if single is not None:
        entries = read_camera_file(single)
        if len(entries) == 1:
            camera = entries[0].camera
            name = camera.name or "camera"
            return {name: camera.model_copy(update={"name": name})}
        return {e.camera.name: e.camera for e in entries}
    files = (
        sorted(p for p in several.iterdir() if p.suffix in (".yaml", ".yml", ".json"))
        if several.is_dir()
        else []
    )
    if not files:
        raise InvalidInput(
            "No camera file: without the lens nothing can be calibrated.",
            where=str(folder / "camera_info.yaml"),
            next_step="write the camera's size, matrix and distortion there (OpenCV, ROS or Kalibr YAML)",
        )
    cameras = {}
    for path in files:
        entries = read_camera_file(path)
        fitting = [e for e in entries if e.camera.name == path.stem] or entries
        cameras[path.stem] = fitting[0].camera.model_copy(update={"name": path.stem})
    return cameras


def _image_folders(folder: Path, cameras: dict[str, Camera]) -> dict[str, Path]:
    """Where each camera's images lie.

    Raises
    ------
    InvalidInput : a folder of images without a camera file, or a camera without images.
    """
    below = sorted(p.name for p in (folder / "images").iterdir() if p.is_dir())
    if not below:
        if len(cameras) == 1:
            return {next(iter(cameras)): folder / "images"}
        raise InvalidInput(
            f"There are {len(cameras)} cameras and one folder of images.", where=str(folder / "images"),
            next_step="put each camera's images into a folder of its name, as images/left/pose1.png",
        )  # fmt: skip
    lacking = [name for name in below if name not in cameras]
    if lacking and len(cameras) == 1 and len(below) == 1:
        return {next(iter(cameras)): folder / "images" / below[0]}
    if lacking:
        raise InvalidInput(
            f"Camera {lacking[0]} has images and no camera file.", where=str(folder / "images" / lacking[0]),
            next_step=f"write camera_info/{lacking[0]}.yaml; known are {', '.join(sorted(cameras))}",
        )  # fmt: skip
    empty = [name for name in cameras if name not in below]
    if empty:
        raise InvalidInput(
            f"Camera {empty[0]} has a camera file and no images.", where=str(folder / "images" / empty[0]),
            next_step="add its images, or take its camera file away",
        )  # fmt: skip
    return {name: folder / "images" / name for name in below}


def _by_name(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    return {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in suffixes and p.is_file()}


def read_cloud(path: Path) -> PointCloud:
    """Finite points of a cloud; rings where it has any.

    Raises
    ------
    InvalidInput : the file is damaged.
    """
    cloud = read_points(path, 0)
    points = np.column_stack((cloud.x_m, cloud.y_m, cloud.z_m)).astype(np.float64)
    good = np.isfinite(points).all(axis=1) & (points != 0).any(axis=1)
    ring = cloud.ring[good].astype(np.int64) if len(np.unique(cloud.ring)) > 1 else None
    return PointCloud(points[good], cloud.intensity[good].astype(np.float64), ring)


def read_image(shown: Shown, camera: Camera) -> NDArray[np.uint8]:
    """A grey image (h, w) of the size the camera has.

    Raises
    ------
    InvalidInput : it is no image, or not that camera's.
    """
    image = grey(shown.image(camera.name))
    where = shown.where(camera.name)
    if image is None:
        raise InvalidInput(
            "This is no image.", where=where, next_step="replace it, or take the placement away"
        )
    h, w = image.shape
    if (w, h) != (camera.model.width_px, camera.model.height_px):
        raise InvalidInput(
            f"The image has {w} x {h} pixels, camera {camera.name} has {camera.model.width_px} x {camera.model.height_px}: it "
            "is not this camera's, or was scaled or cut.",
            where=where,
            next_step="use the images as recorded, and the camera file of this camera",
        )
    return image
