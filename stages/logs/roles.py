"""Which topic is the LiDAR, the IMU, the GNSS, the wheels: by type and rate, and what is ambiguous is said."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.schemas.session import Problem
from scanloom.stages.logs.records import Kind, LivoxCloud, LogSource, PointCloud2, TopicInfo

ROLES: dict[str, Kind] = {"lidar": "cloud", "imu": "imu", "gnss": "gnss", "wheel": "wheel"}
_DERIVED = (
    "map", "filtered", "ground", "obstacle", "segment", "registered", "downsample", "voxel", "cluster", "merged",
    "accumulated", "deskew", "undistort", "costmap", "trajectory", "odom", "corner", "surf", "radar", "depth",
)  # fmt: skip
_TYPES = {
    "lidar": "sensor_msgs/PointCloud2 or livox CustomMsg",
    "imu": "sensor_msgs/Imu",
    "gnss": "sensor_msgs/NavSatFix",
    "wheel": "nav_msgs/Odometry, geometry_msgs/TwistStamped or TwistWithCovarianceStamped",
}
NONE = "none"
"""A setting with this word leaves the sensor out."""


@dataclass
class Roles:
    """The topics that are used; empty where the log has none."""

    lidar: str = ""
    imu: str = ""
    gnss: str = ""
    wheel: str = ""
    problems: list[Problem] = field(default_factory=list)
    points: dict[str, int] = field(default_factory=dict)
    """Points in the first message of each cloud topic looked at."""

    def of(self, role: str) -> str:
        topic: str = getattr(self, role)
        return topic

    def used(self) -> dict[str, str]:
        """Topic name to role."""
        return {self.of(role): role for role in ROLES if self.of(role)}


def assign_roles(source: LogSource, wanted: dict[str, str]) -> Roles:
    """Choose a topic per role; `wanted` names topics by role (empty: choose, `none`: leave out).

    Raises
    ------
    UsageError : a wanted topic does not exist or has an unsuitable type.
    """
    roles = Roles()
    for role, kind in ROLES.items():
        candidates = [topic for topic in source.topics if topic.kind == kind and topic.count]
        name = wanted.get(role, "")
        if name == NONE:
            continue
        chosen = _named(source.topics, role, kind, name) if name else _best(source, role, candidates, roles)
        setattr(roles, role, chosen)
    return roles


def _named(topics: Sequence[TopicInfo], role: str, kind: Kind, name: str) -> str:
    by_name = {topic.name: topic for topic in topics}
    if name not in by_name:
        near = difflib.get_close_matches(name, by_name, 1, 0.3)
        hint = f"did you mean {near[0]}?" if near else "see `scanloom inspect` for the topics"
        raise UsageError(f"ingest.{role}_topic is {name}, which the log does not have.", next_step=hint)
    if by_name[name].kind != kind:
        raise UsageError(
            f"ingest.{role}_topic is {name} of type {by_name[name].type}.",
            next_step=f"name a topic of type {_TYPES[role]}",
        )
    return name


def _best(source: LogSource, role: str, candidates: list[TopicInfo], roles: Roles) -> str:
    # a map or a path that is sent once is no sensor
    candidates = [topic for topic in candidates if topic.count > 1] or candidates
    if not candidates:
        return ""
    if len(candidates) == 1:
        return candidates[0].name
    if role == "lidar":
        roles.points = {topic.name: _first_size(source, topic) for topic in candidates}
    ranked = sorted(candidates, key=lambda topic: (_demerits(role, topic, roles), topic.name))
    best, others = ranked[0], ranked[1:]
    rates = ", ".join(f"{topic.name} ({_rate(topic)})" for topic in others[:4])
    more = " and more" if len(others) > 4 else ""
    roles.problems.append(
        Problem(
            code=f"{role}.ambiguous",
            severity="warning" if role == "lidar" and _comparable(best, others[0]) else "info",
            text=f"The log has {len(candidates)} topics that could be the {role}: {best.name} ({_rate(best)}) is used, "
            f"not {rates}{more}. Choose with ingest.{role}_topic.",
            topic=best.name,
        )
    )
    return best.name


def _comparable(a: TopicInfo, b: TopicInfo) -> bool:
    """Whether the choice between two clouds may well be wrong: neither is by its name or rate a derived one."""
    return _demerits("lidar", a, Roles())[:2] == _demerits("lidar", b, Roles())[:2]


def _first_size(source: LogSource, topic: TopicInfo) -> int:
    """Points of the topic's first message, from its header; 0 when it cannot be read."""
    for message in source.messages({topic.name}):
        body = message.body
        if isinstance(body, PointCloud2):
            return body.width * body.height
        if isinstance(body, LivoxCloud):
            return len(body.points)
        break
    return 0


def _demerits(role: str, topic: TopicInfo, roles: Roles) -> tuple[float, ...]:
    """Smaller is better: derived data last, sensible rates first, then the richest."""
    derived = sum(word in topic.name.lower() for word in _DERIVED)
    if role == "lidar":
        odd_rate = not 2e7 <= topic.period_ns <= 5e8
        return (odd_rate, derived > 0, -roles.points.get(topic.name, 0), -topic.count)
    if role == "wheel":
        # odometry topics of SLAM or localisation are no wheel measurement
        words = ("wheel", "vehicle", "velocity", "controller", "twist", "speed", "can", "chassis")
        fused = (
            "filtered",
            "fused",
            "lidar",
            "visual",
            "vio",
            "lio",
            "slam",
            "gps",
            "gnss",
            "imu",
            "truth",
            "ground",
        )
        name = topic.name.lower()
        return (sum(w in name for w in fused), -sum(w in name for w in words), topic.period_ns or 1e12)
    return (derived > 0, topic.period_ns or 1e12, -topic.count)


def _rate(topic: TopicInfo) -> str:
    return f"{1e9 / topic.period_ns:.0f} Hz" if topic.period_ns else f"{topic.count} message"


def no_lidar(source: LogSource, where: str) -> InvalidInput:
    """The error of a log without a usable 3D LiDAR, which says what it holds instead."""
    kinds = {
        "imu": "IMU",
        "gnss": "GNSS",
        "wheel": "odometry or wheel speed",
        "tf": "transforms",
        "images": "images",
    }
    found = [
        label
        for kind, label in kinds.items()
        if any(topic.kind == kind and topic.count for topic in source.topics)
    ]
    lasers = [t.name for t in source.topics if t.type.endswith(("/LaserScan", "/MultiEchoLaserScan"))]
    if lasers:
        found.insert(0, f"a 2D laser scanner ({lasers[0]}), which sees one plane only")
    packets = [t.name for t in source.topics if t.type.split("/")[-1] in _PACKETS]
    if packets:
        found.insert(0, f"raw packets of a LiDAR driver ({packets[0]}), which are not decoded")
    holds = _sentence(found) if found else f"{len(source.topics)} topics, none of a kind that is known"
    unreadable = [t for t in source.topics if t.remark and t.count]
    if unreadable:
        holds += f", and {len(unreadable)} topics in another encoding ({unreadable[0].name}: {unreadable[0].remark})"
    if source.damage:
        return InvalidInput(
            f"The log is damaged, and what can be read of it has no point cloud: {'; '.join(source.damage.texts[:3])}.",
            where=where,
            next_step="copy the log again from where it was recorded, or give another one",
        )
    return InvalidInput(
        f"The log has no 3D LiDAR topic (sensor_msgs/PointCloud2 or livox CustomMsg). It holds {holds}.",
        where=where,
        next_step="give a log with point clouds; raw packets must first be turned into clouds by the sensor's driver"
        if packets
        else "record the point cloud topic of the 3D LiDAR too, or give another log",
    )


_PACKETS = (
    "VelodyneScan",
    "PacketMsg",
    "PandarScan",
    "RslidarScan",
    "HesaiScan",
    "RslidarPacket",
    "UdpFrame",
)


def _sentence(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
