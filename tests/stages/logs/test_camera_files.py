"""Kalibr, OpenCV, ROS and `calibration.json`, alone and through a session file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.logs.camera_files import pick, read_camera_file
from scanloom.stages.logs.camera_options import Settings
from scanloom.stages.logs.inspection import inspect_log
from scanloom.stages.logs.locate import locate
from tests.stages.images.rig import drive
from tests.stages.logs.writing import ROS2, write_mcap

T_CAM_LIDAR = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 0.0, 1.0]]
T_LIDAR_CAM = [[0.0, 0.0, 1.0, 0.3], [-1.0, 0.0, 0.0, 0.1], [0.0, -1.0, 0.0, -0.2], [0.0, 0.0, 0.0, 1.0]]
T_CN_CNM1 = [[1.0, 0.0, 0.0, -0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def kalibr_camera(**changes: Any) -> dict[str, Any]:
    return {
        "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": [-0.1, 0.02, 1e-3, -1e-3],
        "intrinsics": [40.0, 41.0, 31.5, 23.5], "resolution": [64, 48], "rostopic": "/cam_front/image_raw",
    } | changes  # fmt: skip


def write(path: Path, content: Any) -> Path:
    path.write_text(
        json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content, sort_keys=False)
    )
    return path


def test_kalibr_chain(tmp_path: Path) -> None:
    """The second camera stands on the first."""
    chain = {
        "cam0": kalibr_camera(T_cam_lidar=T_CAM_LIDAR),
        "cam1": kalibr_camera(
            distortion_model="equidistant", T_cn_cnm1=T_CN_CNM1, rostopic="/cam_rear/image_raw"
        ),
        "cam2": kalibr_camera(distortion_model="none", distortion_coeffs=[]),
    }
    first, second, third = read_camera_file(write(tmp_path / "chain.yaml", chain))
    assert (first.camera.name, first.topic, first.camera.source) == ("cam0", "/cam_front/image_raw", "kalibr")
    assert first.camera.model.distortion == (-0.1, 0.02, 1e-3, -1e-3)
    np.testing.assert_allclose(first.camera.T_lidar_camera, T_LIDAR_CAM, atol=1e-12)
    assert second.camera.model.lens == "equidistant"
    np.testing.assert_allclose(
        second.camera.T_lidar_camera, np.array(T_LIDAR_CAM) @ np.linalg.inv(T_CN_CNM1), atol=1e-12
    )
    assert third.camera.model.lens == "pinhole" and third.camera.T_lidar_camera is None


def test_a_kalibr_chain_that_hangs_on_no_lidar_says_so(tmp_path: Path) -> None:
    chain = {"cam0": kalibr_camera(T_cam_imu=T_CAM_LIDAR), "cam1": kalibr_camera(T_cn_cnm1=T_CN_CNM1)}
    first, second = read_camera_file(write(tmp_path / "chain.yaml", chain))
    assert first.camera.T_lidar_camera is None and second.camera.T_lidar_camera is None
    assert "T_cam_imu of cam0 alone do not say" in first.remark and "T_cn_cnm1 of cam1" in second.remark


WRONG = {
    "omni": (kalibr_camera(camera_model="omni"), "cam0 is of camera model 'omni'"),
    "fov": (kalibr_camera(distortion_model="fov"), "'fov', which is unknown"),
    "size": ({k: v for k, v in kalibr_camera().items() if k != "resolution"}, "cam0 has no resolution"),
    "numbers": (kalibr_camera(intrinsics=[1.0, 2.0]), "not enough values"),
    "matrix": (kalibr_camera(T_cam_lidar=[[1.0, 0.0]]), "T_cam_lidar of cam0 is no 4x4 matrix"),
    "none": (kalibr_camera(distortion_model="none"), "distortion coefficients all the same"),
}


@pytest.mark.parametrize("case", WRONG)
def test_kalibr_files_that_make_no_sense(case: str, tmp_path: Path) -> None:
    entry, reason = WRONG[case]
    with pytest.raises(InvalidInput, match=reason):
        read_camera_file(write(tmp_path / "chain.yaml", {"cam0": entry}))


@pytest.mark.parametrize(("fisheye", "count"), [(False, 4), (False, 5), (False, 8), (True, 4)])
def test_opencv_as_opencv_writes_it(fisheye: bool, count: int, tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 64)
    storage.write("image_height", 48)
    storage.write("fisheye_model", int(fisheye))
    storage.write("camera_matrix", np.array([[40.0, 0, 31.5], [0, 41.0, 23.5], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.arange(1, count + 1)[:, None] * 0.01)
    storage.release()
    (entry,) = read_camera_file(tmp_path / "camera.yml")
    model = entry.camera.model
    assert model.lens == ("equidistant" if fisheye else "radial-tangential")
    assert model.distortion == pytest.approx([0.01 * (i + 1) for i in range(count)])
    assert (model.width_px, model.height_px, model.fy_px, model.cx_px) == (64, 48, 41.0, 31.5)


def test_ros_calibration(tmp_path: Path) -> None:
    content = {
        "image_width": 64, "image_height": 48, "camera_name": "narrow", "distortion_model": "plumb_bob",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [40.0, 0, 31.5, 0, 41.0, 23.5, 0, 0, 1]},
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.1, 0.02, 1e-3, -1e-3, 0.0]},
    }  # fmt: skip
    (entry,) = read_camera_file(write(tmp_path / "ost.yaml", content))
    assert entry.camera.name == "narrow" and entry.camera.model.distortion == (-0.1, 0.02, 1e-3, -1e-3, 0.0)


def test_the_file_of_a_real_fisheye(shared_data: Path) -> None:
    (entry,) = read_camera_file(shared_data / "lidar_camera_board/camera_info.yaml")
    assert entry.camera.model.lens == "equidistant" and entry.camera.model.width_px == 1920
    assert entry.camera.model.distortion == (-0.0540096, -0.0784275, 0.0959641, -0.0515253)


MODEL = CameraModel(lens="pinhole", width_px=64, height_px=48, fx_px=50, fy_px=50, cx_px=31, cy_px=23)
PLACED = tuple(tuple(row) for row in T_LIDAR_CAM)


def calibration(**changes: Any) -> dict[str, Any]:
    cameras = [
        Camera(name=name, model=MODEL, T_lidar_camera=PLACED, readout_s=0.01)
        for name in ("cam_front", "cam_rear")
    ]
    return {"schema": "calibration", "version": 1, "verdict": "good", "reason": "it agrees",
            "cameras": [camera.model_dump(mode="json") for camera in cameras]} | changes  # fmt: skip


def test_calibration_json_gives_all_its_cameras(tmp_path: Path) -> None:
    first, second = read_camera_file(write(tmp_path / "calibration.json", calibration()))
    assert first.camera == Camera(
        name="cam_front", model=MODEL, T_lidar_camera=PLACED, readout_s=0.01, source="calibration"
    )
    assert second.camera.name == "cam_rear" and second.remark == ""
    doubtful = calibration(verdict="doubtful", reason="three placements only")
    first, _ = read_camera_file(write(tmp_path / "calibration.json", doubtful))
    assert "doubtful: three placements only" in first.remark


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.yaml", "just words", "describes no camera"),
        ("a.yaml", "{a: 1}", "describes no camera"),
        ("a.yaml", "a: [", "cannot be read"),
        ("a.json", "{", "cannot be read"),
        ("a.json", '{"cameras": []}', "holds no camera"),
        ("a.json", '{"cameras": [{"name": "a"}]}', "model: Field required"),
        ("a.yaml", "camera_matrix: [1, 0, 0]", "cannot reshape"),
        ("a.yaml", "camera_matrix: [40, 0, 31, 0, 41, 23, 0, 0, 1]", "does not say how large the image is"),
        ("a.yaml", "{camera_matrix: [40, 3, 31, 0, 41, 23, 0, 0, 1], image_size: [64, 48]}", "skew of 3 px"),
    ],
)
def test_files_that_are_no_camera(name: str, text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidInput, match=reason) as raised:
        read_camera_file(tmp_path / name)
    assert raised.value.next_step
    with pytest.raises(InvalidInput, match="No such file"):
        read_camera_file(tmp_path / "absent.yaml")


def test_which_camera_of_a_file_is_meant(tmp_path: Path) -> None:
    entries = read_camera_file(write(tmp_path / "c.json", calibration()))
    assert pick(entries, "cam_rear", "x", "", "c.json").camera.name == "cam_rear"
    assert pick(entries, "", "cam_rear", "", "c.json").camera.name == "cam_rear"
    assert pick(entries[:1], "", "x", "", "c.json").camera.name == "cam_front"
    with pytest.raises(
        InvalidInput, match=r"2 cameras, none of them called x.*cam_front, cam_rear.*c\.json#cam_front"
    ):
        pick(entries, "", "x", "", "c.json")
    with pytest.raises(InvalidInput, match=r"no camera roof"):
        pick(entries, "roof", "cam_front", "", "c.json")


# --- through a session file ------------------------------------------------------------------------------------------


def session(folder: Path, text: str) -> Path:
    write_mcap(folder / "log.mcap", drive(ROS2, 4))
    (folder / "session.yaml").write_text(f"log: log.mcap\n{text}")
    return folder / "session.yaml"


def given(folder: Path, text: str) -> Settings:
    return Settings.model_validate(locate(session(folder, text)).settings.get("images", {}))


def test_a_session_file_takes_a_calibration_as_it_is(tmp_path: Path) -> None:
    write(tmp_path / "calibration.json", calibration())
    settings = given(tmp_path, "calibration: calibration.json\ncameras: {cam_rear: {clock_offset_s: 0.02}}\n")
    front, rear = settings.cameras
    assert front.name == "cam_front" and front.model == MODEL and front.T_lidar_camera == PLACED
    assert (front.clock_offset_s, front.readout_s, front.source) == (0.0, 0.01, "calibration")
    assert rear.clock_offset_s == 0.02 and rear.model == MODEL


def test_a_session_file_gives_cameras_one_by_one(tmp_path: Path) -> None:
    write(
        tmp_path / "chain.yaml",
        {"cam0": kalibr_camera(), "cam1": kalibr_camera(rostopic="/cam_rear/image_raw")},
    )
    settings = given(
        tmp_path,
        "cameras:\n"
        "  front: {topic: /cam_front/image_raw, model: chain.yaml, T_lidar_camera: [0.3, 0.1, -0.2, -1.5707963267948966, 0, -1.5707963267948966]}\n"
        f"  rear: {{topic: /cam_rear/image_raw/compressed, model: chain.yaml#cam1, T_lidar_camera: {T_LIDAR_CAM}}}\n"
        "  roof: {topic: none}\n",
    )  # fmt: skip
    front, rear, roof = settings.cameras
    np.testing.assert_allclose(front.T_lidar_camera, T_LIDAR_CAM, atol=1e-12)
    assert front.model is not None and front.model.fx_px == 40.0 and front.source == "kalibr"
    assert rear.T_lidar_camera == PLACED and roof.topic == "none"


def test_inspection_lists_cameras(tmp_path: Path) -> None:
    write(tmp_path / "calibration.json", calibration(cameras=calibration()["cameras"][1:]))
    found = inspect_log(session(tmp_path, "calibration: calibration.json\n"))
    front, rear = found.cameras
    assert (front.name, front.images, front.width_px, front.height_px) == ("cam_front", 4, 64, 48)
    assert (front.lens, front.mounted, front.source) == ("radial-tangential", True, "camera info, tf")
    assert (rear.lens, rear.mounted, rear.source) == ("pinhole", True, "calibration")
    assert found.as_json()["cameras"][0]["topic"] == "/cam_front/image_raw"
    assert not [problem for problem in found.problems if problem.code == "camera.remark"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera: {}", r"unknown key: camera\..*did you mean cameras\?"),
        ("calibraton: a.json", r"unknown key: calibraton\..*did you mean calibration\?"),
        ("cameras: {front: {topics: /a}}", r"cameras\.front\.topics.*did you mean topic\?"),
        ("cameras: {front: {T_camera_lidar: []}}", r"T_camera_lidar.*did you mean T_lidar_camera\?"),
        ("cameras: {front: {T_lidar_camera: [1, 2]}}", r"cameras\.front\.T_lidar_camera: .*6 numbers"),
        ("cameras: {front: {T_lidar_camera: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}}", r"cameras\.front\.T_lidar_camera: .*is no pose"),
        ("cameras: {front: {readout_s: -1}}", r"cameras\.front\.readout_s"),
        ("cameras: {'a b': {topic: none}}", r"cameras\.a b\.name"),
    ],
)  # fmt: skip
def test_session_files_with_wrong_cameras(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=message):
        locate(session(tmp_path, text + "\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("calibration: absent.json", "No such file"),
        ("cameras: {front: {model: absent.yaml}}", "No such file"),
        ("calibration: opencv.yaml", r"does not name its camera.*cameras: \{NAME: \{model: opencv\.yaml\}\}"),
    ],
)
def test_session_files_whose_cameras_are_not_there(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "opencv.yaml").write_text(
        "{camera_matrix: [40, 0, 31, 0, 41, 23, 0, 0, 1], image_size: [64, 48]}"
    )
    with pytest.raises(InvalidInput, match=message):
        locate(session(tmp_path, text + "\n"))
