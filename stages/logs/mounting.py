"""Where the sensors sit on the vehicle: from the user, from tf, from a calibration, else assumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from scanloom.schemas.session import IDENTITY, Extrinsic, Matrix4, Problem
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp
from scanloom.stages.logs.records import Transforms

SENSORS: tuple[Literal["lidar", "imu", "gnss", "wheel"], ...] = ("lidar", "imu", "gnss", "wheel")
_BASES = ("base_link", "base", "base_footprint", "body", "vehicle", "baselink", "base_frame", "ego_vehicle")
_WORLDS = ("map", "odom", "world", "earth", "utm", "odom_combined", "ecef", "local", "enu")
_MAX_EDGES = 2000


@dataclass
class TfTree:
    """Edges of the tf tree that do not move."""

    edges: dict[tuple[str, str], F8] = field(default_factory=dict)
    moving: set[tuple[str, str]] = field(default_factory=set)

    def note(self, message: Transforms) -> None:
        """Take in one message; an edge that changes is no mounting."""
        for item in message.transforms:
            key = (item.parent, item.child)
            known = self.edges.get(key)
            if known is None:
                if len(self.edges) < _MAX_EDGES:
                    self.edges[key] = item.T_parent_child
            elif not message.static and np.abs(known - item.T_parent_child).max() > 1e-4:
                self.moving.add(key)

    def rigid(self) -> dict[str, list[tuple[str, F8]]]:
        """Neighbours of each frame with T_frame_neighbour, over edges that do not move."""
        graph: dict[str, list[tuple[str, F8]]] = {}
        for (parent, child), T in self.edges.items():
            if (parent, child) in self.moving or parent in _WORLDS:
                continue
            graph.setdefault(parent, []).append((child, T))
            graph.setdefault(child, []).append((parent, inverse(T)))
        return graph

    def between(self, start: str, end: str) -> F8 | None:
        """T_start_end where edges that do not move join the frames."""
        if start == end and start:
            return np.eye(4)
        graph = self.rigid()
        return _reach(graph, start).get(end) if start in graph else None

    def root_of(self, frame: str) -> str:
        """Topmost frame above `frame` that is rigidly joined to it."""
        above = {c: p for p, c in self.edges if (p, c) not in self.moving and p not in _WORLDS}
        seen = {frame}
        while frame in above and above[frame] not in seen:
            frame = above[frame]
            seen.add(frame)
        return frame


def resolve(
    tree: TfTree,
    frames: Mapping[str, str],
    given: Mapping[str, tuple[float, ...]],
    known: Sequence[Extrinsic],
) -> tuple[tuple[Extrinsic, ...], list[Problem]]:
    """Extrinsics of the sensors in use, and what had to be assumed.

    Parameters
    ----------
    frames : frame name of each sensor in use (from message headers).
    given : what the user says, by sensor: 6 numbers (x, y, z in m, roll, pitch, yaw in rad) or 16 (row by row).
    known : what the log's own calibration says.
    """
    from_log = {extrinsic.sensor: extrinsic for extrinsic in known}
    from_tf, base = _from_tf(tree, frames)
    out: list[Extrinsic] = []
    assumed: list[str] = []
    for sensor in SENSORS:
        if sensor not in frames:
            continue
        if sensor in given:
            out.append(Extrinsic(sensor=sensor, T_base_sensor=_given(given[sensor]), source="session file"))
        elif sensor in from_log:
            out.append(from_log[sensor])
        elif sensor in from_tf:
            out.append(Extrinsic(sensor=sensor, T_base_sensor=_tuple(from_tf[sensor]), source="tf"))
        elif frames[sensor] in _BASES:
            out.append(Extrinsic(sensor=sensor, T_base_sensor=IDENTITY, source="measured in the base"))
        else:
            out.append(Extrinsic(sensor=sensor, T_base_sensor=IDENTITY, source="assumed identity"))
            assumed.append(sensor)
    return tuple(out), _problems(assumed, frames, base if from_tf else "")


def _from_tf(tree: TfTree, frames: Mapping[str, str]) -> tuple[dict[str, F8], str]:
    graph = tree.rigid()
    lidar = frames.get("lidar", "")
    if lidar not in graph:
        return {}, ""
    reach = _reach(graph, lidar)
    base = next((name for name in _BASES if name in reach), "") or tree.root_of(lidar)
    T_base_lidar = inverse(reach[base])
    found = {sensor: T_base_lidar @ reach[frame] for sensor, frame in frames.items() if frame in reach}
    return found, base


def _reach(graph: Mapping[str, list[tuple[str, F8]]], start: str) -> dict[str, F8]:
    """T_start_frame of every frame rigidly joined to `start`."""
    found = {start: np.eye(4)}
    queue = [start]
    while queue:
        frame = queue.pop(0)
        for neighbour, T in graph.get(frame, ()):
            if neighbour not in found:
                found[neighbour] = found[frame] @ T
                queue.append(neighbour)
    return found


def _problems(assumed: list[str], frames: Mapping[str, str], base: str) -> list[Problem]:
    problems = []
    if base and base not in _BASES:
        problems.append(
            Problem(
                code="extrinsics.base",
                severity="info",
                text=f"The log has no frame called base_link; {base} is taken as the vehicle's base.",
            )
        )
    # with the LiDAR alone every base is as good as any other
    if assumed and len(frames) > 1 and "lidar" in frames:
        names = ", ".join(f"{sensor} (frame {frames[sensor] or 'unnamed'})" for sensor in assumed)
        options = " and ".join(f"ingest.{sensor}_on_base" for sensor in assumed)
        problems.append(
            Problem(
                code="extrinsics.assumed",
                severity="warning",
                text=f"The log does not say where these sit on the vehicle: {names}. They are taken to sit at the base, "
                f"axes aligned with it. Give {options} if you know better.",
            )
        )
    return problems


def _given(values: tuple[float, ...]) -> Matrix4:
    return _tuple(pose_of_numbers(values))


def pose_of_numbers(values: Sequence[float]) -> F8:
    """A pose of 6 numbers (x, y, z in m, roll, pitch, yaw in rad) or 16 (row by row)."""
    if len(values) == 16:
        return np.reshape(np.array(values, float), (4, 4))
    x, y, z, roll, pitch, yaw = values
    R = so3_exp([0, 0, yaw]) @ so3_exp([0, pitch, 0]) @ so3_exp([roll, 0, 0])
    return pose(R, [x, y, z])


def as_matrix4(T: F8 | None) -> Matrix4 | None:
    """A pose as plain numbers; nothing stays nothing."""
    return None if T is None else _tuple(T)


def _tuple(T: F8) -> Matrix4:
    rows: Any = tuple(tuple(float(v) for v in row) for row in T)
    return rows  # type: ignore[no-any-return]
