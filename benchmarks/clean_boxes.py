"""Boxes of a KITTI drive as truth: which points are on something that moves, which on something parked.

Labels are those of KITTI's tracking benchmark (Geiger, Lenz, Urtasun, CVPR 2012): per frame, what stands in the camera's
view. They come without a word on who moves: a box whose track moves through the map is moving, else parked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan, PointClass
from scanloom.stages.geometry.se3 import F8, inverse, pose

LABELS = Path("labels/tracklets_cam2.txt")
CALIBRATION = "calib_tracking.txt"
NOBODY = "DontCare"
MARGIN_M = 0.1
"""Boxes are drawn by hand: they grow by this to the sides and upwards."""
GROUND_M = 0.2
"""What is lower above the foot of a box is the road as often as a tyre."""
MOVES_M, WINDOW = 1.0, 20
"""A track moves when it does so by a metre within 20 frames (2 s), or keeps that pace when it is shorter. Drift of poses and
of hand-drawn boxes adds up to metres over a whole track."""


@dataclass(frozen=True)
class BoxTrack:
    """One object: its boxes by scan. A box is T_lidar_box (4, 4), its origin in the middle of the foot, x along its length."""

    number: int
    what: str
    T_lidar_box: Mapping[int, F8]
    size_m: F8
    """(3,) length, width, height."""
    moving: bool


def read_boxes(path: Path, T_map_lidar: F8) -> list[BoxTrack]:
    """Tracks of a label file beside its calibration; poses (m, 4, 4) of the scans tell who moves. Numbers start at 1.

    Frames without a scan are passed over.
    """
    T_lidar_camera = lidar_from_camera(path.with_name(CALIBRATION))
    boxes: dict[int, dict[int, F8]] = {}
    sizes: dict[int, tuple[str, F8]] = {}
    for line in path.read_text().splitlines():
        words = line.split()
        frame = int(words[0])
        if words[2] == NOBODY or frame >= len(T_map_lidar):
            continue
        number = int(words[1]) + 1
        height, width, length, x, y, z, turn = (float(word) for word in words[10:17])
        boxes.setdefault(number, {})[frame] = T_lidar_camera @ _in_camera(x, y, z, turn)
        sizes[number] = (words[2], np.array([length, width, height]))
    return [
        BoxTrack(number, *_named(sizes[number], boxes[number]), moves(boxes[number], T_map_lidar))
        for number in sorted(boxes)
    ]


def _named(size: tuple[str, F8], boxes: dict[int, F8]) -> tuple[str, dict[int, F8], F8]:
    return size[0], boxes, size[1]


def _in_camera(x: float, y: float, z: float, turn: float) -> F8:
    """T_camera_box of a label: foot at x right, y down, z forward, turned about y from x; the box's z is up."""
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, s, 0.0], [0.0, 0.0, -1.0], [-s, c, 0.0]])
    return pose(R, np.array([x, y, z]))


def lidar_from_camera(path: Path) -> F8:
    """T_lidar_camera (4, 4) of the rectified camera, from a calibration file of the tracking benchmark."""
    rows = {
        words[0].rstrip(":"): words[1:] for words in map(str.split, path.read_text().splitlines()) if words
    }
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3] = np.array(rows["Tr_velo_cam"], float).reshape(3, 4)
    R_rectified = np.eye(4)
    R_rectified[:3, :3] = np.array(rows["R_rect"], float).reshape(3, 3)
    return np.asarray(np.linalg.inv(R_rectified @ T_camera_lidar))


def moves(boxes: Mapping[int, F8], T_map_lidar: F8) -> bool:
    """Whether boxes by scan move through the map: the median over windows of the track is at a metre in two seconds."""
    frames = sorted(boxes)
    at = np.array([(T_map_lidar[f] @ boxes[f])[:3, 3] for f in frames])
    apart = min(WINDOW, len(frames) - 1)
    if apart < 1:
        return False
    way = np.linalg.norm(at[apart:] - at[:-apart], axis=1)
    passed = np.array(frames)[apart:] - np.array(frames)[:-apart]
    return bool(np.median(way / passed) * WINDOW > MOVES_M)


def boxed(
    scan: DeskewedScan, tracks: Sequence[BoxTrack], otherwise: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Class and number of the object (n,) of every point: DYNAMIC or STATIC in a box, `otherwise` and 0 outside all."""
    points = scan.points().astype(np.float64)
    true_class = np.full(len(points), otherwise, np.uint8)
    instance = np.zeros(len(points), np.uint16)
    for track in tracks:
        if scan.scan_index not in track.T_lidar_box:
            continue
        held = in_box(points, track.T_lidar_box[scan.scan_index], track.size_m)
        true_class[held] = PointClass.DYNAMIC if track.moving else PointClass.STATIC
        instance[held] = track.number
    return true_class, instance


def in_box(points: F8, T_lidar_box: F8, size_m: F8) -> NDArray[np.bool_]:
    """Which points (n, 3) are in a box, m; the lowest of it, where the road is, left out."""
    T = inverse(T_lidar_box)
    own = points @ T[:3, :3].T + T[:3, 3]
    half = size_m[:2] / 2 + MARGIN_M
    level = (np.abs(own[:, :2]) <= half).all(axis=1)
    return np.asarray(level & (own[:, 2] > GROUND_M) & (own[:, 2] <= size_m[2] + MARGIN_M))
