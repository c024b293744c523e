"""Other formats, read back."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest

from benchmarks.board_scenes import World, rig
from scanloom.schemas.cameras import Camera
from scanloom.stages.calibrate.document import matrix
from scanloom.stages.calibrate.exports import exports, roll_pitch_yaw, static_tf
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp
from scanloom.stages.logs.camera_files import read_camera_file


@pytest.fixture(scope="module")
def cameras():
    models, poses = rig(World(), np.random.default_rng(1))
    return [
        Camera(name=n, model=models[n], T_lidar_camera=matrix(poses[n]), source="calibration")
        for n in sorted(models)
    ]


def test_opencv_reads_it(cameras, tmp_path):
    for camera in cameras:
        path = tmp_path / f"opencv_{camera.name}.yaml"
        path.write_text(exports(cameras)[path.name])
        store = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        np.testing.assert_allclose(
            store.getNode("T_lidar_camera").mat(), np.array(camera.T_lidar_camera), atol=1e-11
        )
        np.testing.assert_allclose(
            store.getNode("T_camera_lidar").mat(), inverse(np.array(camera.T_lidar_camera)), atol=1e-11
        )
        assert store.getNode("camera_matrix").mat()[0, 0] == camera.model.fx_px
        (entry,) = read_camera_file(path)
        assert entry.camera.model == camera.model


def test_kalibr_gives_the_same_lenses(cameras, tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(exports(cameras)["kalibr_camchain.yaml"])
    entries = read_camera_file(path)
    for camera, entry in zip(cameras, entries, strict=True):
        assert (entry.camera.model.fx_px, entry.camera.model.cy_px) == (
            camera.model.fx_px,
            camera.model.cy_px,
        )
        given = np.resize(np.array([*camera.model.distortion, 0, 0, 0, 0]), 4)
        np.testing.assert_allclose(np.resize([*entry.camera.model.distortion, 0, 0, 0, 0], 4), given)


def test_urdf_leads_to_the_optical_frames(cameras):
    root = ET.fromstring(exports(cameras)["rig.urdf"])
    joints = {j.find("child").get("link"): j for j in root.findall("joint")}
    for camera in cameras:
        T = np.eye(4)
        link = f"{camera.name}_optical_frame"
        while link != "lidar":
            origin = joints[link].find("origin")
            xyz, rpy = (np.array([float(v) for v in origin.get(k).split()]) for k in ("xyz", "rpy"))
            T = pose(turned(*rpy), xyz) @ T
            link = joints[link].find("parent").get("link")
        np.testing.assert_allclose(T, np.array(camera.T_lidar_camera), atol=1e-6)


def turned(roll, pitch, yaw):
    return so3_exp([0, 0, yaw]) @ so3_exp([0, pitch, 0]) @ so3_exp([roll, 0, 0])


@pytest.mark.parametrize("angles", [(0.1, -0.4, 2.0), (0.0, np.pi / 2, 0.7), (-3.0, 0.2, -3.0)])
def test_roll_pitch_yaw(angles):
    R = turned(*angles)
    np.testing.assert_allclose(turned(*roll_pitch_yaw(R)), R, atol=1e-9)


def test_kitti_and_launch_file(cameras):
    lines = dict(line.split(": ", 1) for line in exports(cameras)["kitti_calib.txt"].splitlines())
    Tr = np.array(lines["Tr_velo_to_cam1"].split(), float).reshape(3, 4)
    np.testing.assert_allclose(Tr, inverse(np.array(cameras[1].T_lidar_camera))[:3], atol=1e-9)
    compile(static_tf(cameras, "lidar"), "static_tf.launch.py", "exec")
