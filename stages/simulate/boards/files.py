"""The folder of a calibration session, as a user would have made it, with the truth apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera
from scanloom.stages.simulate.boards.scan import Cloud
from scanloom.stages.simulate.boards.session import BoardSession

TRUTH_FILE = "truth.json"
_MODELS = {"pinhole": "plumb_bob", "radial-tangential": "plumb_bob", "equidistant": "fisheye"}


def write_session(session: BoardSession, folder: Path, truth: Path | None = None) -> None:
    """clouds/NAME.pcd, images/CAMERA/NAME.png, camera_info/CAMERA.yaml, board.yaml; the truth to `truth`, if given."""
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    (folder / "camera_info").mkdir(exist_ok=True)
    (folder / "board.yaml").write_text(board_yaml(session))
    for camera in session.given:
        (folder / "camera_info" / f"{camera.name}.yaml").write_text(camera_yaml(camera))
        (folder / "images" / camera.name).mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(session.names):
        (folder / "clouds" / f"{name}.pcd").write_bytes(pcd(session.cloud(k)))
        for camera in session.given:
            image = session.image(camera.name, k)
            (folder / "images" / camera.name / f"{name}.png").write_bytes(png(image))
    if truth is not None:
        write_truth(session, truth)


def write_truth(session: BoardSession, path: Path) -> None:
    """Cameras, boards and what is wrong, as JSON."""
    path.write_text(json.dumps(session.truth(), indent=1) + "\n")


def board_yaml(session: BoardSession) -> str:
    """The board, as `calibrate` reads it."""
    b = session.board
    lines = [
        f"inner_corners: {list(b.inner_corners)}",
        f"square_m: {b.square_m}",
        f"board_m: {list(b.board_m)}",
        f"offset_m: {list(b.offset_m)}",
    ]
    return "\n".join(lines) + "\n"


def camera_yaml(camera: Camera) -> str:
    """Lens and size, keys as in a CameraInfo message."""
    m = camera.model
    coefficients = list(m.distortion) or [0.0] * 4
    K = [m.fx_px, 0.0, m.cx_px, 0.0, m.fy_px, m.cy_px, 0.0, 0.0, 1.0]
    lines = [
        f"distortion_model: {_MODELS[m.lens]}",
        f"width: {m.width_px}",
        f"height: {m.height_px}",
        f"D: {coefficients}",
        f"K: {K}",
    ]
    return "\n".join(lines) + "\n"


def pcd(cloud: Cloud) -> bytes:
    """PCD 0.7, binary."""
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2")])
    n = len(cloud.ring)
    points = np.zeros(n, layout)
    points["x"], points["y"], points["z"] = cloud.points_m.T
    points["intensity"], points["ring"] = cloud.intensity, cloud.ring
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS x y z intensity ring",
        "SIZE 4 4 4 4 2",
        "TYPE F F F F U",
        "COUNT 1 1 1 1 1",
        f"WIDTH {n}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {n}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode() + points.tobytes()


def png(image: NDArray[np.uint8]) -> bytes:
    """A file of an image (h, w, 3), red green blue."""
    import cv2

    _, data = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 3])
    return bytes(data.tobytes())
