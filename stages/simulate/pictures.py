"""Messages of cameras: their images, and their lenses beside each of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.simulate.cameras import NAMES, model, optical
from scanloom.stages.simulate.footage import Shot
from scanloom.stages.simulate.recording import Entry, class_of, header, serialised
from scanloom.stages.simulate.settings import Settings

IMAGE, INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
DELAY_NS = 31_000_000
"""From the end of an image to the recorder."""
_MODELS = {"radial-tangential": "plumb_bob", "equidistant": "equidistant"}


def image_topic(name: str) -> str:
    """Where a camera's images are."""
    return f"/{name}/image_raw/compressed"


def info_topic(name: str) -> str:
    """Where its lens is."""
    return f"/{name}/camera_info"


def camera_topics(settings: Settings) -> dict[str, str]:
    """Type of each topic of the cameras."""
    topics = {}
    for name in NAMES[: settings.cameras]:
        topics[image_topic(name)] = IMAGE
        topics[info_topic(name)] = INFO
    return topics


def camera_entries(settings: Settings, shots: Iterator[Shot]) -> Iterator[Entry]:
    """Two messages for each image."""
    models = [model(settings, k) for k in range(settings.cameras)]
    for shot in shots:
        name = NAMES[shot.camera]
        head = header(shot.stamp_ns, optical(name))
        image = class_of(IMAGE)(header=head, format="jpeg", data=np.frombuffer(shot.jpeg, np.uint8))
        received = shot.end_ns + DELAY_NS
        yield received, image_topic(name), shot.stamp_ns, serialised(IMAGE, image)
        info = lens_message(models[shot.camera], head)
        yield received, info_topic(name), shot.stamp_ns, serialised(INFO, info)


def lens_message(lens: CameraModel, head: object) -> object:
    """The camera info of a lens."""
    K = np.array([lens.fx_px, 0.0, lens.cx_px, 0.0, lens.fy_px, lens.cy_px, 0.0, 0.0, 1.0])
    P = np.column_stack((K.reshape(3, 3), np.zeros(3))).ravel()
    region = class_of("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    return class_of(INFO)(
        header=head,
        height=lens.height_px,
        width=lens.width_px,
        distortion_model=_MODELS[lens.lens],
        d=np.array(lens.distortion),
        k=K,
        r=np.eye(3).ravel(),
        p=P,
        binning_x=0,
        binning_y=0,
        roi=region,
    )
