"""Images of every kind of log, thinned and on the LiDAR's clock; cameras with lens and mounting."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from scanloom.schemas.cameras import CameraModel, Cameras, Image
from scanloom.schemas.errors import UsageError
from scanloom.schemas.product import Part
from scanloom.schemas.session import Session
from scanloom.stages import ingest
from scanloom.stages.geometry.pictures import decode
from scanloom.stages.images import Settings, images
from scanloom.stages.logs.camera_options import GivenCamera
from scanloom.stages.logs.locate import locate
from tests.stages.images.rig import (
    FRONT_XYZ,
    HEIGHT,
    OPTICAL,
    WIDTH,
    compressed,
    drive,
    edge,
    info,
    jpeg,
    picture,
    raw,
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


def with_info(items: list[Item], **changes: Any) -> Iterator[Item]:
    """Three scans, the items, and the camera info of `/cam_front`."""
    message = info(ROS2, START_NS, "front_optical", **changes)
    items = [
        *scans(ROS2, 3),
        *items,
        Item("/cam_front/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, message),
    ]
    return iter(sorted(items, key=lambda item: item.receive_ns))


def picture_item(
    message: Any, ns: int = START_NS + 1, topic: str = "/cam_front/image_raw", kind: str = "Image"
) -> Item:
    return Item(topic, f"sensor_msgs/msg/{kind}", ns, message)


def all_of(parts: dict[str, list[Image]], camera: str) -> list[Image]:
    return [image for part in parts.values() for image in part if image.camera == camera]


def only_image(tmp_path: Path, message: Any, kind: str = "Image") -> tuple[Image | None, Cameras]:
    """What becomes of a single image of `/cam_front`."""
    topic = "/cam_front/image_raw" if kind == "Image" else "/cam_front/image_raw/compressed"
    write_mcap(tmp_path / "log.mcap", with_info([picture_item(message, topic=topic, kind=kind)]))
    parts, cameras, _ = run(tmp_path / "log.mcap")
    found = all_of(parts, "cam_front")
    return (found[0] if found else None), cameras


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


COLOUR = picture(1)
GREY = picture(1, 1)
DEEP = GREY.astype(np.uint16) * 16 + 7
"""12 bits in 16."""
RAW = {
    "mono8": (GREY, GREY),
    "8UC1": (GREY, GREY),
    "mono16": (DEEP, GREY),
    "bgr8": (COLOUR, COLOUR[:, :, ::-1]),
    "rgb8": (COLOUR, COLOUR),
    "bgra8": (np.dstack((COLOUR, GREY)), COLOUR[:, :, ::-1]),
    "rgba8": (np.dstack((COLOUR, GREY)), COLOUR),
    "bgr16": (COLOUR.astype(np.uint16) * 257, COLOUR[:, :, ::-1]),
}


@pytest.mark.parametrize("encoding", RAW)
@pytest.mark.parametrize("pad", [0, 6])
def test_raw_images_lose_nothing(encoding: str, pad: int, tmp_path: Path) -> None:
    pixels, expected = RAW[encoding]
    image, _ = only_image(tmp_path, raw(ROS2, START_NS + 1, pixels, encoding, pad=pad))
    assert image is not None and image.encoding == "png"
    np.testing.assert_array_equal(decode(image), expected)
    stored = cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED)
    assert stored.dtype == pixels.dtype


def test_big_endian_samples(tmp_path: Path) -> None:
    message = raw(ROS2, START_NS + 1, DEEP.astype(">u2"), "mono16")
    message.is_bigendian = 1
    image, _ = only_image(tmp_path, message)
    assert image is not None
    np.testing.assert_array_equal(decode(image), GREY)


def test_mosaics_and_videos_get_their_colours(tmp_path: Path) -> None:
    """A red field under each filter pattern, and as YUV."""
    red = np.zeros((HEIGHT, WIDTH), np.uint8)
    for pattern, (row, column) in {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}.items():
        mosaic = red.copy()
        mosaic[row::2, column::2] = 200
        for name, message, kind in (
            ("raw", raw(ROS2, START_NS + 1, mosaic, f"bayer_{pattern}8"), "Image"),
            ("png", compressed(ROS2, START_NS + 1, cv2.imencode(".png", mosaic)[1], f"bayer_{pattern}8; png compressed "), "CompressedImage"),
        ):  # fmt: skip
            folder = tmp_path / f"{pattern}_{name}"
            folder.mkdir()
            image, _ = only_image(folder, message, kind)
            assert image is not None
            np.testing.assert_array_equal(
                decode(image)[5:-5, 5:-5].reshape(-1, 3).mean(0).round(), [200, 0, 0]
            )
    for encoding, order in (("yuv422", (1, 0)), ("yuv422_yuy2", (0, 1))):
        pairs = np.empty((HEIGHT, WIDTH, 2), np.uint8)
        pairs[:, :, order[0]] = 63
        pairs[:, 0::2, order[1]], pairs[:, 1::2, order[1]] = 102, 240
        (tmp_path / encoding).mkdir()
        image, _ = only_image(tmp_path / encoding, raw(ROS2, START_NS + 1, pairs, encoding))
        assert image is not None
        r, g, b = decode(image).reshape(-1, 3).mean(0)
        assert r > 200 and g < 20 and b < 20


def cut(data: np.ndarray) -> np.ndarray:
    return data[: len(data) // 2]


DAMAGED = {
    "cut jpeg": ("CompressedImage", lambda: compressed(ROS2, START_NS + 1, cut(jpeg(COLOUR))), "the JPEG is not whole"),
    "cut png": ("CompressedImage", lambda: compressed(ROS2, START_NS + 1, cut(cv2.imencode(".png", COLOUR)[1].ravel()), "png"), "the PNG is not whole"),
    "no image": ("CompressedImage", lambda: compressed(ROS2, START_NS + 1, np.arange(99)), "neither JPEG nor PNG"),
    "nothing": ("CompressedImage", lambda: compressed(ROS2, START_NS + 1, np.empty(0)), "neither JPEG nor PNG"),
    "short": ("Image", lambda: short_image(), "ends after 9000 of 9216 bytes"),
    "narrow rows": ("Image", lambda: narrow_rows(), "in rows of 100 bytes make no sense"),
    "depth": ("Image", lambda: raw(ROS2, START_NS + 1, GREY.astype(np.float32), "32FC1"), "'32FC1' is no picture"),
}  # fmt: skip


def short_image() -> Any:
    message = raw(ROS2, START_NS + 1, COLOUR, "bgr8")
    message.data = message.data[:9000]
    return message


def narrow_rows() -> Any:
    message = raw(ROS2, START_NS + 1, COLOUR, "bgr8")
    message.step = 100
    return message


@pytest.mark.parametrize("case", DAMAGED)
def test_damaged_images_are_counted_and_named(case: str, tmp_path: Path) -> None:
    kind, message, reason = DAMAGED[case]
    image, cameras = only_image(tmp_path, message(), kind)
    assert image is None
    assert (cameras.footage[0].kept, cameras.footage[0].damaged) == (0, 1)
    assert any(reason in remark and "1 images of /cam_front" in remark for remark in cameras.remarks), (
        cameras.remarks
    )


def test_after_a_damaged_image_the_next_is_taken(tmp_path: Path) -> None:
    """Not the next in half a second."""
    good, bad = jpeg(COLOUR), cut(jpeg(COLOUR))
    items = [
        picture_item(
            compressed(ROS2, START_NS + ns, data), START_NS + ns, "/cam_front/compressed", "CompressedImage"
        )
        for ns, data in ((10, bad), (100_000_000, good), (200_000_000, good))
    ]
    write_mcap(tmp_path / "log.mcap", with_info(items))
    parts, cameras, _ = run(tmp_path / "log.mcap")
    assert [image.stamp_ns - START_NS for image in all_of(parts, "cam_front")] == [100_000_000]
    assert cameras.footage[0].damaged == 1


def test_parts_and_spacing(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 25))
    parts, cameras, session = run(tmp_path / "log.mcap", chunk_s=1.0, spacing_s=0.3)
    assert list(parts) == ["0000", "0001", "0002"]
    for key, part in parts.items():
        stamps = [image.stamp_ns for image in part]
        assert stamps == sorted(stamps)
        assert all((stamp - session.start_ns) // 10**9 == int(key) for stamp in stamps)
    stamps = np.array([image.stamp_ns for image in all_of(parts, "cam_rear")])
    np.testing.assert_array_equal(np.diff(stamps), 300_000_000)
    parts, cameras, _ = run(tmp_path / "log.mcap", spacing_s=0.0)
    assert [f.kept for f in cameras.footage] == [25, 25]


def test_cameras_recorded_out_of_order_come_in_order(tmp_path: Path) -> None:
    """The front camera's images arrive 0.9 s after they were taken."""
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 20, late_ns=900_000_000))
    parts, cameras, _ = run(tmp_path / "log.mcap", chunk_s=1.0)
    stamps = [image.stamp_ns for part in parts.values() for image in part]
    assert stamps == sorted(stamps) and len(stamps) == 8
    assert not any("older" in remark for remark in cameras.remarks)


def test_a_clock_offset_is_subtracted(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 6))
    offset = GivenCamera(name="cam_front", clock_offset_s=0.025)
    parts, cameras, _ = run(tmp_path / "log.mcap", cameras=(offset,))
    assert all_of(parts, "cam_front")[0].stamp_ns == START_NS + 5_000_000
    assert all_of(parts, "cam_rear")[0].stamp_ns == START_NS + 30_000_000
    assert cameras.cameras[0].clock_offset_s == 0.025


def test_a_camera_with_a_clock_of_its_own_is_shifted_and_said(tmp_path: Path) -> None:
    items = []
    for i in range(10):
        ns = START_NS + i * 100_000_000
        items.append(picture_item(raw(ROS2, ns - 5_000_000_000, picture(i), "bgr8"), ns + 100_000_000))
    write_mcap(tmp_path / "log.mcap", with_info(items))
    parts, cameras, _ = run(tmp_path / "log.mcap")
    assert all_of(parts, "cam_front")[0].stamp_ns == START_NS
    assert any("shifted by 5.000 s" in remark for remark in cameras.remarks)
    parts, cameras, _ = run(tmp_path / "log.mcap", align_clocks=False)
    assert parts == {} and any("does not overlap" in remark for remark in cameras.remarks)


def test_without_camera_info_a_camera_is_left_out_and_told(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 5, infos=False))
    parts, cameras, _ = run(tmp_path / "log.mcap")
    assert parts == {} and cameras.cameras == ()
    assert len(cameras.remarks) == 2
    for name, remark in zip(("cam_front", "cam_rear"), cameras.remarks, strict=True):
        assert f"Camera {name}" in remark and f"cameras: {{{name}: {{model: FILE}}}}" in remark


def test_a_model_that_is_given_needs_no_camera_info(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 5, infos=False, tf=False))
    model = CameraModel(
        lens="pinhole", width_px=WIDTH, height_px=HEIGHT, fx_px=50, fy_px=50, cx_px=31, cy_px=23
    )
    given = GivenCamera(name="left", topic="/cam_front/image_raw", model=model, T_lidar_camera=T_LIDAR_FRONT)
    parts, cameras, _ = run(tmp_path / "log.mcap", cameras=(given,))
    assert [camera.name for camera in cameras.cameras] == ["left"]
    assert cameras.cameras[0].model == model and cameras.cameras[0].T_lidar_camera == T_LIDAR_FRONT
    assert cameras.cameras[0].source == "session file" and len(all_of(parts, "left")) == 1


INFOS: dict[str, tuple[dict[str, Any], str]] = {
    "never calibrated": ({"k": np.zeros(9)}, "was never calibrated"),
    "strange lens": ({"distortion_model": "omni"}, "'omni', which is unknown"),
    "not a number": ({"k": np.full(9, np.nan)}, "not finite"),
    "too many": ({"d": np.ones(12)}, "12 distortion coefficients are more"),
    "another size": ({"width": 640, "height": 400}, "that is another camera"),
}


@pytest.mark.parametrize("case", INFOS)
def test_camera_info_that_makes_no_sense(case: str, tmp_path: Path) -> None:
    changes, reason = INFOS[case]
    item = picture_item(raw(ROS2, START_NS + 1, COLOUR, "bgr8"))
    write_mcap(tmp_path / "log.mcap", with_info([item], **changes))
    parts, cameras, _ = run(tmp_path / "log.mcap")
    assert parts == {} and cameras.cameras == ()
    assert any(reason in remark for remark in cameras.remarks), cameras.remarks


def test_lenses_of_camera_info(tmp_path: Path) -> None:
    for n, (name, d, lens, count) in enumerate((
        ("plumb_bob", np.zeros(5), "pinhole", 0), ("", np.empty(0), "pinhole", 0), ("equidistant", np.full(4, 0.01), "equidistant", 4),
        ("rational_polynomial", np.full(8, 0.01), "radial-tangential", 8), ("plumb_bob", np.full(4, 0.01), "radial-tangential", 4),
        ("fisheye", np.zeros(4), "equidistant", 4),
    )):  # fmt: skip
        item = picture_item(raw(ROS2, START_NS + 1, COLOUR, "bgr8"))
        write_mcap(tmp_path / f"{n}.mcap", with_info([item], distortion_model=name, d=d))
        _, cameras, _ = run(tmp_path / f"{n}.mcap")
        assert (cameras.cameras[0].model.lens, len(cameras.cameras[0].model.distortion)) == (lens, count)


def test_images_smaller_than_calibrated_scale_the_model(tmp_path: Path) -> None:
    """Half the size: the edges of the image, half a pixel beyond the outer centres, stay edges."""
    item = picture_item(raw(ROS2, START_NS + 1, COLOUR[::2, ::2].copy(), "bgr8"))
    write_mcap(tmp_path / "log.mcap", with_info([item]))
    _, cameras, _ = run(tmp_path / "log.mcap")
    model = cameras.cameras[0].model
    assert (model.width_px, model.height_px, model.fx_px, model.cx_px) == (32, 24, 20.0, 15.5)
    assert any("the model is scaled" in remark for remark in cameras.remarks)


def test_binning_and_cuts_of_the_sensor(tmp_path: Path) -> None:
    region = ROS2.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=10, y_offset=4, height=0, width=0, do_rectify=False
    )
    item = picture_item(raw(ROS2, START_NS + 1, COLOUR, "bgr8"))
    changes = {"roi": region, "binning_x": 2, "binning_y": 2, "width": 2 * WIDTH, "height": 2 * HEIGHT}
    write_mcap(tmp_path / "log.mcap", with_info([item], **changes))
    _, cameras, _ = run(tmp_path / "log.mcap")
    model = cameras.cameras[0].model
    assert (model.width_px, model.fx_px, model.cx_px, model.cy_px) == (
        WIDTH,
        20.0,
        (31.5 - 10) / 2,
        (23.5 - 4) / 2,
    )


def test_a_frame_with_the_axes_of_a_housing_is_turned(tmp_path: Path) -> None:
    """tf of a driver that names its x forward: the camera still looks ahead."""
    item = picture_item(raw(ROS2, START_NS + 1, COLOUR, "bgr8", frame="front"))
    mounted = Item("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, edge(ROS2, START_NS, "lidar", "front", FRONT_XYZ, (1.0, 0.0, 0.0, 0.0)))  # fmt: skip
    items = [*scans(ROS2, 3), item, mounted, Item("/cam_front/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info(ROS2, START_NS, "front"))]  # fmt: skip
    write_mcap(tmp_path / "log.mcap", iter(sorted(items, key=lambda i: i.receive_ns)))
    _, cameras, _ = run(tmp_path / "log.mcap")
    np.testing.assert_allclose(cameras.cameras[0].T_lidar_camera, T_LIDAR_FRONT, atol=1e-12)
    assert any("axes of a housing" in remark for remark in cameras.remarks)


def test_a_frame_that_moves_is_no_mounting(tmp_path: Path) -> None:
    items = list(with_info([picture_item(raw(ROS2, START_NS + 1, COLOUR, "bgr8"))]))
    for i in range(3):
        ns = START_NS + i * 1_000_000
        items.append(
            Item(
                "/tf",
                "tf2_msgs/msg/TFMessage",
                ns,
                edge(ROS2, ns, "lidar", "front_optical", (0.1 * i, 0.0, 0.0), OPTICAL),
            )
        )
    write_mcap(tmp_path / "log.mcap", iter(sorted(items, key=lambda i: i.receive_ns)))
    _, cameras, _ = run(tmp_path / "log.mcap")
    assert cameras.cameras[0].T_lidar_camera is None
    assert any("no rigid tf from lidar to front_optical" in remark for remark in cameras.remarks)


def test_topics_that_are_not_there_are_an_error(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 3))
    with pytest.raises(
        UsageError, match=r"/cam_frnt/image_raw, which the log does not have.*did you mean /cam_front"
    ):
        run(tmp_path / "log.mcap", cameras=(GivenCamera(name="a", topic="/cam_frnt/image_raw"),))
    with pytest.raises(UsageError, match=r"/points, is of type sensor_msgs/msg/PointCloud2"):
        run(tmp_path / "log.mcap", cameras=(GivenCamera(name="a", topic="/points"),))


def test_a_camera_that_is_described_and_not_there_is_told(tmp_path: Path) -> None:
    write_mcap(tmp_path / "log.mcap", drive(ROS2, 3))
    _, cameras, _ = run(tmp_path / "log.mcap", cameras=(GivenCamera(name="roof"),))
    assert [camera.name for camera in cameras.cameras] == ["cam_front", "cam_rear"]
    assert any(
        "Camera roof is described" in remark and "cam_front, cam_rear" in remark for remark in cameras.remarks
    )
