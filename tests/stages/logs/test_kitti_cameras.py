"""Images and cameras of KITTI folders: raw rectified, raw as recorded, odometry."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from scanloom.schemas.cameras import Camera
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp, transform
from scanloom.stages.images import Settings
from scanloom.stages.logs.cameras import find_cameras
from scanloom.stages.logs.kitti import open_kitti
from scanloom.stages.logs.locate import locate
from scanloom.stages.logs.records import ImageFile
from tests.stages.images.test_images import run
from tests.stages.logs.kitti_folder import DRIVE, odometry_sequence, raw_drive, stamp_lines

SIZE = (96, 40)
K = np.array([[70.0, 0.0, 47.0], [0.0, 70.0, 19.0], [0.0, 0.0, 1.0]])
R_RECT = so3_exp([0.01, -0.02, 0.005])
T_CAM0_VELO = pose(
    np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ so3_exp([0.01, 0.02, -0.01]), [0.01, -0.08, -0.3]
)
BASELINE_M = 0.54


def line(key: str, values: object) -> str:
    return f"{key}: {' '.join(f'{v:.9e}' for v in np.ravel(np.asarray(values, float)))}\n"


def P(baseline_m: float) -> np.ndarray:
    return np.column_stack((K, K @ [-baseline_m, 0.0, 0.0]))


def pictures(folder: Path, count: int) -> None:
    folder.mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"{i:010d}.png"), np.full(SIZE[::-1], 20 * i, np.uint8))


def with_cameras(root: Path, count: int = 4, *, rectified: bool = True) -> Path:
    date = raw_drive(root, count)
    for camera in ("image_00", "image_02"):
        pictures(date / DRIVE / camera / "data", count)
        (date / DRIVE / camera / "timestamps.txt").write_text(stamp_lines(count))
    (date / "calib_velo_to_cam.txt").write_text(
        "calib_time: x\n" + line("R", T_CAM0_VELO[:3, :3]) + line("T", T_CAM0_VELO[:3, 3])
    )
    text = ""
    for number, baseline in (("00", 0.0), ("02", BASELINE_M)):
        text += (
            line(f"S_{number}", (100, 45))
            + line(f"K_{number}", K)
            + line(f"D_{number}", [-0.3, 0.1, 1e-3, 1e-3, 0.0])
        )
        text += line(f"R_{number}", np.eye(3)) + line(f"T_{number}", [-baseline, 0, 0])
        text += (
            line(f"S_rect_{number}", SIZE)
            + line(f"R_rect_{number}", R_RECT)
            + line(f"P_rect_{number}", P(baseline))
        )
    (date / "calib_cam_to_cam.txt").write_text("corner_dist: 9.95e-02\n" + text)
    if not rectified:
        (date / DRIVE).rename(date / DRIVE.replace("_sync", "_extract"))
    return date


def expected_pixels(points: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """The development kit's own formula."""
    homogeneous = np.column_stack((transform(T_CAM0_VELO, points) @ R_RECT.T, np.ones(len(points))))
    uvw = homogeneous @ projection.T
    return uvw[:, :2] / uvw[:, 2:]


def ours(camera: Camera, points: np.ndarray) -> np.ndarray:
    return project(camera.model, transform(inverse(np.array(camera.T_lidar_camera)), points))[0]


POINTS = np.random.default_rng(0).uniform((5, -3, -1), (30, 3, 1), (50, 3))


def test_rectified_raw_drive(tmp_path: Path) -> None:
    parts, cameras, session = run(with_cameras(tmp_path / "2011_09_26", 11))
    assert [camera.name for camera in cameras.cameras] == ["image_00", "image_02"]
    for camera, projection in zip(cameras.cameras, (P(0.0), P(BASELINE_M)), strict=True):
        assert camera.source == "kitti calibration" and camera.model.lens == "pinhole"
        assert (camera.model.width_px, camera.model.height_px) == SIZE
        np.testing.assert_allclose(ours(camera, POINTS), expected_pixels(POINTS, projection), atol=1e-5)
    stamps = [image.stamp_ns - session.start_ns for image in parts["0000"] if image.camera == "image_02"]
    assert np.diff(stamps).tolist() == [500_000_000] * 2
    assert cameras.remarks == ()


def test_raw_drive_as_recorded(tmp_path: Path) -> None:
    """Not rectified: the lens of the camera itself, which stands as the calibration's R and T say."""
    source = open_kitti(locate(with_cameras(tmp_path / "2011_09_26", rectified=False)).raw_log)
    front = source.cameras[1]
    assert front.model.lens == "radial-tangential" and front.model.width_px == 100
    distorted, _ = cv2.projectPoints(
        transform(T_CAM0_VELO, POINTS) - [BASELINE_M, 0, 0], np.zeros(3), np.zeros(3), K, np.array([-0.3, 0.1, 1e-3, 1e-3, 0.0])
    )  # fmt: skip
    np.testing.assert_allclose(ours(front, POINTS), distorted[:, 0], atol=1e-5)


def test_odometry_sequence(tmp_path: Path) -> None:
    root = odometry_sequence(tmp_path / "00", 6)
    pictures(root / "image_2", 6)
    rect_velo = pose(R_RECT, np.zeros(3)) @ T_CAM0_VELO
    (root / "calib.txt").write_text(
        line("P0", P(0.0)) + line("P2", P(BASELINE_M)) + line("Tr", rect_velo[:3])
    )
    parts, cameras, _ = run(root)
    assert [camera.name for camera in cameras.cameras] == ["image_2"]
    np.testing.assert_allclose(
        ours(cameras.cameras[0], POINTS), expected_pixels(POINTS, P(BASELINE_M)), atol=1e-5
    )
    assert [image.stamp_ns for image in parts["0000"]] == [0, 518_000_000]


def test_without_calibration_the_cameras_are_named_and_left_out(tmp_path: Path) -> None:
    date = with_cameras(tmp_path / "2011_09_26")
    (date / "calib_cam_to_cam.txt").unlink()
    (date / DRIVE / "image_00/timestamps.txt").unlink()
    source = open_kitti(locate(date).raw_log)
    codes = {problem.code for problem in source.problems}
    assert {"kitti.camera_calibration", "kitti.images_without_time"} <= codes
    found = find_cameras(source, Settings())
    assert [(camera.name, camera.usable) for camera in found.found] == [("image_02", False)]
    assert "cameras: {image_02: {model: FILE}}" in found.remarks[0]


def test_a_drive_without_images_knows_no_camera(tmp_path: Path) -> None:
    source = open_kitti(locate(raw_drive(tmp_path / "2011_09_26")).raw_log)
    assert source.cameras == ()
    assert not [problem for problem in source.problems if "camera" in problem.code]


@pytest.mark.parametrize("damage", ["cut", "gone"])
def test_a_damaged_file_is_counted(damage: str, tmp_path: Path) -> None:
    date = with_cameras(tmp_path / "2011_09_26", 2)
    source = locate(date)
    path = date / DRIVE / "image_02/data/0000000000.png"
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:40])
    else:
        path.write_bytes(b"")
    parts, cameras, _ = run(source.raw_log.root / DRIVE)
    assert [f.damaged for f in cameras.footage] == [0, 1]
    assert [image.camera for image in parts["0000"]] == ["image_00", "image_02"]
    assert any("1 images of image_02 are damaged" in remark for remark in cameras.remarks)
    assert isinstance(next(open_kitti(source.raw_log).messages({"image_02"})).body, ImageFile)
