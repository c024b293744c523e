"""Images of every kind of log, thinned and on the LiDAR's clock; cameras with lens and mounting."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.cameras import Cameras, Image
from scanloom.schemas.product import Part
from scanloom.schemas.session import Session
from scanloom.stages import ingest
from scanloom.stages.geometry.pictures import decode
from scanloom.stages.images import Settings, images
from scanloom.stages.logs.camera_options import GivenCamera
from scanloom.stages.logs.locate import locate
from tests.stages.images.rig import (
    FRONT_XYZ,
    drive,
    info,
    jpeg,
    picture,
    scans,
)
from tests.stages.logs.writing import (
    ROS1,
    ROS2,
    START_NS,
    Item,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

T_LIDAR_FRONT = ((0.0, 0.0, 1.0, FRONT_XYZ[0]), (-1.0, 0.0, 0.0, FRONT_XYZ[1]), (0.0, -1.0, 0.0, FRONT_XYZ[2]), (0.0, 0.0, 0.0, 1.0))  # fmt: skip


def run(path: Path, **settings: Any) -> tuple[dict[str, list[Image]], Cameras, Session]:
    """Parts by key, the document, the session; everything as the engine has it."""
    raw_log = locate(path).raw_log
    *_, session = ingest.ingest(ingest.Settings(), raw_log)
    assert isinstance(session, Session)
    parts: dict[str, list[Image]] = {}
    document = None
    for item in images(Settings(**settings), raw_log, session):
        if isinstance(item, Part):
            parts[item.key] = list(item.product)
        else:
            document = item
    assert document is not None
    return parts, document, session


def all_of(parts: dict[str, list[Image]], camera: str) -> list[Image]:
    return [image for part in parts.values() for image in part if image.camera == camera]


def one_image(tmp_path: Path, message: Any, topic: str = "/cam_front/image_raw", kind: str = "Image", **settings: Any) -> tuple[list[Image], Cameras]:  # fmt: skip
    """What becomes of a single image in a log with its camera info."""
    items = [*scans(ROS2, 3), Item(topic, f"sensor_msgs/msg/{kind}", START_NS + 1, message),
             Item("/cam_front/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info(ROS2, START_NS, "front_optical"))]  # fmt: skip
    write_mcap(tmp_path / "log.mcap", iter(sorted(items, key=lambda item: item.receive_ns)))
    parts, cameras, _ = run(tmp_path / "log.mcap", **settings)
    return [image for part in parts.values() for image in part], cameras


WRITERS: dict[str, Callable[[Path], Path]] = {
    "rosbag1": lambda folder: write_rosbag1(folder / "log.bag", drive(ROS1), chunk_bytes=50_000),
    "rosbag2": lambda folder: write_rosbag2(folder / "log", drive(ROS2), "sqlite3"),
    "rosbag2-zstd": lambda folder: write_rosbag2(folder / "log", drive(ROS2), compression="message"),
    "mcap": lambda folder: write_mcap(folder / "log.mcap", drive(ROS2), compression="zstd"),
}


@pytest.mark.parametrize("container", WRITERS)
def test_every_container_gives_the_same(container: str, tmp_path: Path) -> None:
    parts, cameras, _ = run(WRITERS[container](tmp_path))
    assert list(parts) == ["0000"]
    for name in ("cam_front", "cam_rear"):
        stamps = [image.stamp_ns - START_NS for image in all_of(parts, name)]
        assert stamps == [30_000_000 + i * 500_000_000 for i in range(4)]
    front, rear = all_of(parts, "cam_front"), all_of(parts, "cam_rear")
    assert {image.encoding for image in front} == {"png"} and {image.encoding for image in rear} == {"jpeg"}
    np.testing.assert_array_equal(decode(front[1]), picture(5)[:, :, ::-1])
    np.testing.assert_array_equal(rear[1].data, jpeg(picture(5)))
    assert [(f.camera, f.topic, f.images, f.kept, f.damaged) for f in cameras.footage] == [
        ("cam_front", "/cam_front/image_raw", 20, 4, 0), ("cam_rear", "/cam_rear/image_raw/compressed", 20, 4, 0),
    ]  # fmt: skip
    model = cameras.cameras[0].model
    assert (model.lens, model.fx_px, model.cy_px, len(model.distortion)) == (
        "radial-tangential",
        40.0,
        23.5,
        5,
    )
    assert cameras.cameras[0].T_lidar_camera is not None
    np.testing.assert_allclose(cameras.cameras[0].T_lidar_camera, T_LIDAR_FRONT, atol=1e-12)
    assert cameras.cameras[0].source == "camera info, tf"
    assert cameras.cameras[1].T_lidar_camera is None
    assert [remark[:42] for remark in cameras.remarks] == ["Nobody says where camera cam_rear sits (no"]


def test_a_log_without_images_has_no_part(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", scans(ROS2, 3))
    parts, cameras, session = run(tmp_path / "log.mcap")
    assert parts == {} and cameras == Cameras()
    assert not any(topic.role == "images" for topic in session.topics)


def test_images_can_be_left_alone(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 5))
    parts, cameras, _ = run(tmp_path / "log.mcap", use="none")
    assert parts == {} and cameras == Cameras()
    parts, cameras, _ = run(tmp_path / "log.mcap", cameras=(GivenCamera(name="cam_rear", topic="none"),))
    assert [camera.name for camera in cameras.cameras] == ["cam_front"]
    parts, cameras, _ = run(tmp_path / "log.mcap", use="given", cameras=(GivenCamera(name="cam_rear"),))
    assert [camera.name for camera in cameras.cameras] == ["cam_rear"]
