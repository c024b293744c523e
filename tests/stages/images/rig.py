"""A log of a LiDAR and two cameras, written by another library than the readers under test."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from tests.stages.logs.writing import (
    SCAN_NS,
    START_NS,
    Item,
    cloud,
    cloud_points,
    header,
    quaternion,
    transforms,
    vector,
)

WIDTH, HEIGHT = 64, 48
K = (40.0, 0.0, 31.5, 0.0, 41.0, 23.5, 0.0, 0.0, 1.0)
D = (-0.1, 0.02, 0.001, -0.001, 0.0)
FRONT_XYZ = (0.3, -0.1, -0.4)
OPTICAL = (0.5, -0.5, 0.5, -0.5)
"""Quaternion (w, x, y, z) of a camera that looks along x of its parent."""


def picture(i: int, channels: int = 3) -> np.ndarray:
    """A smooth picture, another one for each `i`; blue green red."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    grey = 128 + 60 * np.sin(u / 9 + i) + 50 * np.cos(v / 7)
    if channels == 1:
        return grey.astype(np.uint8)
    return np.stack((grey, np.roll(grey, 5, 1), np.roll(grey, 9, 0)), axis=-1).astype(np.uint8)


def raw(
    store: Any, ns: int, pixels: np.ndarray, encoding: str, frame: str = "front_optical", pad: int = 0
) -> Any:
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    return store.types["sensor_msgs/msg/Image"](
        header=header(store, ns, frame), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
        is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
    )  # fmt: skip


def compressed(store: Any, ns: int, data: np.ndarray, form: str = "jpeg", frame: str = "rear_optical") -> Any:
    return store.types["sensor_msgs/msg/CompressedImage"](
        header=header(store, ns, frame), format=form, data=np.asarray(data, np.uint8).reshape(-1)
    )


def jpeg(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.imencode(".jpg", pixels)[1], np.uint8)


def info(store: Any, ns: int, frame: str, **changes: Any) -> Any:
    ros1 = "D" in store.types["sensor_msgs/msg/CameraInfo"].__dataclass_fields__
    values: dict[str, Any] = {
        "height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", "d": np.array(D), "k": np.array(K),
        "r": np.eye(3).reshape(-1), "p": np.array([*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]), "binning_x": 0, "binning_y": 0,
        "roi": store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    } | changes  # fmt: skip
    if ros1:
        values = {name.upper() if name in "dkrp" else name: value for name, value in values.items()}
    return store.types["sensor_msgs/msg/CameraInfo"](header=header(store, ns, frame), **values)


def edge(store: Any, ns: int, parent: str, child: str, xyz: tuple[float, ...], q: tuple[float, ...]) -> Any:
    message = transforms(store, ns, {(parent, child): xyz})
    item = message.transforms[0].transform
    item.rotation = quaternion(store, *q)
    item.translation = vector(store, *xyz)
    return message


def scans(store: Any, count: int) -> Iterator[Item]:
    for i in range(count):
        ns = START_NS + i * SCAN_NS
        message = cloud(store, ns, cloud_points(i, columns=24))
        yield Item("/points", "sensor_msgs/msg/PointCloud2", ns + SCAN_NS, message)


def drive(
    store: Any, count: int = 20, *, infos: bool = True, tf: bool = True, late_ns: int = 0
) -> Iterator[Item]:
    """Scans at 10 Hz; `/cam_front/image_raw` (bgr8) and `/cam_rear/image_raw/compressed` (JPEG) at 10 Hz."""
    items = list(scans(store, count))
    if tf:
        for parent, child, xyz, q in (
            ("base_link", "lidar", (1.0, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0)),
            ("lidar", "front_optical", FRONT_XYZ, OPTICAL),
        ):
            items.append(Item("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, edge(store, START_NS, parent, child, xyz, q)))  # fmt: skip
    for i in range(count):
        ns = START_NS + i * SCAN_NS + 30_000_000
        items.append(
            Item(
                "/cam_front/image_raw",
                "sensor_msgs/msg/Image",
                ns + late_ns,
                raw(store, ns, picture(i), "bgr8"),
            )
        )
        items.append(
            Item("/cam_rear/image_raw/compressed", "sensor_msgs/msg/CompressedImage", ns + 1, compressed(store, ns, jpeg(picture(i))))
        )  # fmt: skip
        if infos:
            for name in ("front", "rear"):
                message = info(store, ns, f"{name}_optical")
                items.append(Item(f"/cam_{name}/camera_info", "sensor_msgs/msg/CameraInfo", ns + 2, message))
    return iter(sorted(items, key=lambda item: item.receive_ns))
