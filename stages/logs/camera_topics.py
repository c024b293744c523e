"""Which topics are cameras, one topic each, and what to call them."""

from __future__ import annotations

from collections.abc import Sequence

from scanloom.stages.logs.records import TopicInfo

_NO_PICTURES = ("depth", "disparity", "mask", "label", "segment", "confidence", "theora", "costmap")
_LAST_PARTS = {
    "image", "image_raw", "image_color", "image_colour", "image_mono", "image_rect", "image_rect_color", "image_rect_mono",
    "compressed", "raw", "rect", "data", "h264",
}  # fmt: skip
_TOO_COMMON = {"color", "colour", "rgb", "bgr", "mono", "left", "right", "infra1", "infra2", "ir", "camera"}
_UNNAMED = "camera"


def is_picture(topic: TopicInfo) -> bool:
    """Whether the topic holds pictures that a lens made, by its kind and name."""
    return (
        topic.kind == "images" and topic.count > 0 and not any(w in topic.name.lower() for w in _NO_PICTURES)
    )


def is_rectified(topic: str) -> bool:
    """Whether its images were straightened before they were recorded, as ROS names them."""
    return any(part.startswith(("rect", "image_rect")) for part in topic.lower().split("/"))


def place_of(topic: str) -> str:
    """The camera's own part of a topic: `/cam_front/image_raw/compressed` stands at `/cam_front`."""
    parts = topic.strip("/").split("/")
    while len(parts) > 1 and parts[-1].lower() in _LAST_PARTS:
        parts = parts[:-1]
    return "/".join(parts)


def one_per_camera(topics: Sequence[TopicInfo]) -> list[TopicInfo]:
    """Of the topics of one camera the best: colour over grey, as the sensor saw it over rectified, compressed over raw."""
    groups: dict[str, list[TopicInfo]] = {}
    for topic in topics:
        groups.setdefault(place_of(topic.name), []).append(topic)
    return [min(group, key=_demerits) for _, group in sorted(groups.items())]


def names_of(topics: Sequence[str]) -> dict[str, str]:
    """Name of the camera of each topic: the last part of its place that is its own, else more of them."""
    places = {topic: _sensible(place_of(topic)) for topic in topics}
    names: dict[str, str] = {}
    for topic, parts in places.items():
        count = 1 + (parts[-1].lower() in _TOO_COMMON and len(parts) > 1)
        while count < len(parts) and any(
            other != topic and parts[-count:] == theirs[-count:] for other, theirs in places.items()
        ):
            count += 1
        names[topic] = "_".join(parts[-count:])
    return names


def _sensible(place: str) -> list[str]:
    """Parts of a place as letters that a file name may have."""
    parts = [
        "".join(c if c.isalnum() or c in "._-" else "_" for c in part).strip(".") for part in place.split("/")
    ]
    kept = [part for part in parts if part]
    return [_UNNAMED] if not kept or (len(kept) == 1 and kept[0].lower() in _LAST_PARTS) else kept


def _demerits(topic: TopicInfo) -> tuple[bool, bool, bool, int, str]:
    name = topic.name.lower()
    return (
        "mono" in name,
        is_rectified(name),
        not topic.type.endswith("CompressedImage"),
        -topic.count,
        name,
    )
