"""Which topics are cameras and what they are called."""

from __future__ import annotations

import pytest

from scanloom.stages.logs.camera_topics import is_picture, is_rectified, names_of, one_per_camera
from scanloom.stages.logs.records import TopicInfo


def topic(name: str, kind: str = "Image", count: int = 10) -> TopicInfo:
    return TopicInfo(name, f"sensor_msgs/msg/{kind}", "images", count, 0, 1, 1)


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/cam_front/image_raw"], ["cam_front"]),
        (["/cam_front/image_raw/compressed"], ["cam_front"]),
        (["/sensors/camera/front/image_color", "/sensors/camera/rear/image_color"], ["front", "rear"]),
        (["/stereo/left/image_raw", "/stereo/right/image_raw"], ["stereo_left", "stereo_right"]),
        (["/camera/color/image_raw"], ["camera_color"]),
        (["/roof/cam0/image_raw", "/bumper/cam0/image_raw"], ["roof_cam0", "bumper_cam0"]),
        (["/image_raw"], ["camera"]),
        (["image_02"], ["image_02"]),
        (["/a b/c:d/image"], ["c_d"]),
    ],
)
def test_names(topics: list[str], names: list[str]) -> None:
    assert list(names_of(topics).values()) == names


def test_one_topic_per_camera() -> None:
    topics = [
        topic("/a/image_rect_color"), topic("/a/image_raw"), topic("/a/image_raw/compressed", "CompressedImage"), topic("/a/image_mono"),
        topic("/b/image_rect_color"), topic("/c/image_mono"), topic("/c/image_color"),
    ]  # fmt: skip
    chosen = [t.name for t in one_per_camera(topics)]
    assert chosen == ["/a/image_raw/compressed", "/b/image_rect_color", "/c/image_color"]
    assert [is_rectified(name) for name in chosen] == [False, True, False]
    assert not is_rectified("/direct/image_raw")


@pytest.mark.parametrize("name", ["/cam/depth/image_raw", "/stereo/disparity", "/net/segmentation/image"])
def test_what_no_lens_made_is_no_picture(name: str) -> None:
    assert not is_picture(topic(name))
    assert is_picture(topic("/cam/image_raw")) and not is_picture(topic("/cam/image_raw", count=0))
