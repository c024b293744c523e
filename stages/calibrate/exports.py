"""The calibration in formats of others: Kalibr, ROS, OpenCV, KITTI. Text only; each says which way its transforms go."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.stages.geometry.se3 import F8, inverse, quaternion_from_matrix

_RADTAN_LENGTH = 5


def exports(cameras: Sequence[Camera], lidar: str = "lidar") -> dict[str, str]:
    """Contents by file name."""
    placed = [camera for camera in cameras if camera.T_lidar_camera is not None]
    files = {
        "kalibr_camchain.yaml": kalibr(placed),
        "rig.urdf": urdf(placed, lidar),
        "static_tf.launch.py": static_tf(placed, lidar),
        "kitti_calib.txt": kitti(placed),
    }
    return files | {f"opencv_{safe(camera.name)}.yaml": opencv(camera) for camera in placed}


def safe(name: str) -> str:
    """A name that is fine in a file name and as a link of a URDF."""
    return re.sub(r"[^A-Za-z0-9_]", "_", name)


def _T(camera: Camera) -> F8:
    return np.array(camera.T_lidar_camera, float)


def _numbers(values: Sequence[float] | F8) -> str:
    return ", ".join(f"{v:.12g}" for v in values)


def kalibr(cameras: Sequence[Camera]) -> str:
    """A camchain; beside the usual keys `T_cam_lidar` takes LiDAR coordinates to the camera's.

    Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats
    """
    lines, above = [], None
    for i, camera in enumerate(cameras):
        m = camera.model
        distortion, coefficients = _kalibr_distortion(m)
        lines += [
            f"cam{i}:",
            f"  # {camera.name}",
            "  camera_model: pinhole",
            f"  intrinsics: [{_numbers((m.fx_px, m.fy_px, m.cx_px, m.cy_px))}]",
            f"  distortion_model: {distortion}",
            f"  distortion_coeffs: [{_numbers(coefficients)}]",
            f"  resolution: [{m.width_px}, {m.height_px}]",
            f"  rostopic: /{camera.name}/image_raw",
            *_yaml_matrix("T_cam_lidar", inverse(_T(camera))),
        ]
        if above is not None:
            lines += _yaml_matrix("T_cn_cnm1", inverse(_T(camera)) @ above)
        above = _T(camera)
    return "\n".join(lines) + "\n"


def _kalibr_distortion(m: CameraModel) -> tuple[str, tuple[float, ...]]:
    """Kalibr knows four coefficients; a longer radial-tangential lens keeps all of them, which its readers may refuse."""
    if m.lens == "equidistant":
        return "equidistant", (*m.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    if m.lens == "pinhole":
        return "radtan", (0.0, 0.0, 0.0, 0.0)
    rest = m.distortion[4:]
    return "radtan", m.distortion if any(rest) else m.distortion[:4]


def _yaml_matrix(key: str, T: F8) -> list[str]:
    return [f"  {key}:", *(f"    - [{_numbers(row)}]" for row in T)]


def urdf(cameras: Sequence[Camera], lidar: str) -> str:
    """Fixed joints from the LiDAR to each camera's body (x forward, y left, z up) and from there to its optical frame."""
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    lines = ['<?xml version="1.0"?>', '<robot name="rig">', f'  <link name="{lidar}"/>']
    for camera in cameras:
        name, T = safe(camera.name), _T(camera)
        body = T[:3, :3] @ optical.T
        lines += [
            f'  <link name="{name}_link"/>',
            f'  <link name="{name}_optical_frame"/>',
            *_joint(lidar, f"{name}_link", T[:3, 3], body),
            *_joint(f"{name}_link", f"{name}_optical_frame", np.zeros(3), optical),
        ]
    return "\n".join([*lines, "</robot>"]) + "\n"


def _joint(parent: str, child: str, xyz: F8, R: F8) -> list[str]:
    return [
        f'  <joint name="{parent}_to_{child}" type="fixed">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f'    <origin xyz="{" ".join(f"{v:.9f}" for v in xyz)}" rpy="{" ".join(f"{v:.9f}" for v in roll_pitch_yaw(R))}"/>',
        "  </joint>",
    ]


def roll_pitch_yaw(R: F8) -> tuple[float, float, float]:
    """Angles, rad, of R = Rz(yaw) Ry(pitch) Rx(roll), as URDF has them."""
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2])))
    if np.hypot(R[2, 1], R[2, 2]) < 1e-9:
        return 0.0, pitch, float(np.arctan2(-R[0, 1], R[1, 1]))
    return float(np.arctan2(R[2, 1], R[2, 2])), pitch, float(np.arctan2(R[1, 0], R[0, 0]))


def static_tf(cameras: Sequence[Camera], lidar: str) -> str:
    """A ROS 2 launch file that publishes each optical frame in the LiDAR's."""
    lines = [
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription([",
    ]
    for camera in cameras:
        T = _T(camera)
        qw, qx, qy, qz = quaternion_from_matrix(T[:3, :3])
        names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
        given = [f'"{k}", "{v:.9f}"' for k, v in zip(names, (*T[:3, 3], qx, qy, qz, qw))]
        given += [f'"--frame-id", "{lidar}"', f'"--child-frame-id", "{safe(camera.name)}_optical_frame"']
        lines += [
            '        Node(package="tf2_ros", executable="static_transform_publisher", arguments=[',
            "            " + ", ".join(given),
            "        ]),",
        ]
    return "\n".join([*lines, "    ])"]) + "\n"


def opencv(camera: Camera) -> str:
    """What `cv::FileStorage` reads; `T_lidar_camera` takes the camera's coordinates to the LiDAR's, `T_camera_lidar` back."""
    m = camera.model
    K = np.array([[m.fx_px, 0.0, m.cx_px], [0.0, m.fy_px, m.cy_px], [0.0, 0.0, 1.0]])
    distortion = np.array([m.distortion or (0.0,) * (4 if m.lens == "equidistant" else _RADTAN_LENGTH)])
    lines = [
        "%YAML:1.0",
        "---",
        f'camera_name: "{camera.name}"',
        f"image_width: {m.width_px}",
        f"image_height: {m.height_px}",
        f'distortion_model: "{ {"equidistant": "equidistant", "radial-tangential": "plumb_bob", "pinhole": "plumb_bob"}[m.lens] }"',
        f"fisheye_model: {int(m.lens == 'equidistant')}",
        *_opencv_matrix("camera_matrix", K),
        *_opencv_matrix("distortion_coefficients", distortion),
        *_opencv_matrix("T_lidar_camera", _T(camera)),
        *_opencv_matrix("T_camera_lidar", inverse(_T(camera))),
    ]
    return "\n".join(lines) + "\n"


def _opencv_matrix(name: str, M: F8) -> list[str]:
    rows, columns = M.shape
    return [
        f"{name}: !!opencv-matrix",
        f"   rows: {rows}",
        f"   cols: {columns}",
        "   dt: d",
        f"   data: [ {_numbers(M.ravel())} ]",
    ]


def kitti(cameras: Sequence[Camera]) -> str:
    """As KITTI's calibration files: `P<i>` 3x4 of the straightened camera in its own axes, `Tr_velo_to_cam<i>` 3x4."""
    lines = []
    for i, camera in enumerate(cameras):
        m = camera.model
        P = np.array([[m.fx_px, 0.0, m.cx_px, 0.0], [0.0, m.fy_px, m.cy_px, 0.0], [0.0, 0.0, 1.0, 0.0]])
        lines.append(f"P{i}: " + _row(P))
        lines.append(f"Tr_velo_to_cam{i}: " + _row(inverse(_T(camera))[:3]))
    lines.append("R0_rect: " + _row(np.eye(3)))
    return "\n".join(lines) + "\n"


def _row(M: F8) -> str:
    return " ".join(f"{v:.12e}" for v in M.ravel())
