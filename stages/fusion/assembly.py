"""The pose graph of a map: what each kind of measurement says of its nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from scanloom.stages.fusion.bridging import Bridge
from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.fusion.factors import Factor
from scanloom.stages.fusion.gnss import Fixes
from scanloom.stages.fusion.gravity import Gravity
from scanloom.stages.fusion.links import Link
from scanloom.stages.fusion.settings import Settings
from scanloom.stages.fusion.walk import Walk, believed, stated
from scanloom.stages.fusion.wheel import NO_MOTIONS, Odometer
from scanloom.stages.geometry.se3 import F8, inverse, pose

UNSEEN_STD = np.repeat([np.radians(10.0), 10.0], 3)
"""Of odometry along directions that no scan saw, rad and m (methods 1.8): there gyro and wheels decide, and GNSS."""


def assembled(
    settings: Settings, drives: Sequence[Drive], ups: Sequence[Gravity], fixes: Sequence[Fixes],
    found: Sequence[Link], gaps: Sequence[Bridge], odometers: Mapping[str, Odometer], nodes: F8,
) -> list[Factor]:  # fmt: skip
    """Every factor of the map, used or not, session by session."""
    georeferenced = any(f.alignment is not None for f in fixes)
    factors = [_gauge(nodes, georeferenced)]
    for d, up, f in zip(drives, ups, fixes, strict=True):
        factors += _motion_factors(settings, d, odometers.get(d.name), f.walk)
        factors += _gravity_factors(settings, d, up)
        factors += _gnss_factors(d, f)
    factors += [_bridge_factor(bridge) for bridge in gaps]
    return factors + _loop_factors(settings, drives, found)


def _gauge(nodes: F8, georeferenced: bool) -> Factor:
    """Prior on the first pose: holds the frame `map`; in `world` it only keeps the system regular."""
    sigma = np.repeat([10.0, 1e4], 3) if georeferenced else np.array([1.0, 1.0, 1e-3, 1e-3, 1e-3, 1e-3])
    R = nodes[0, :3, :3]
    covariance = np.diag(sigma**2)
    covariance[:3, :3] = R.T @ covariance[:3, :3] @ R
    return Factor("prior", 0, -1, nodes[0], covariance)


def _motion_factors(
    settings: Settings, d: Drive, odometer: Odometer | None, seen: Walk | None
) -> list[Factor]:
    """Odometry between neighbouring keyframes, and the wheels beside it where there are any."""
    wheels = odometer.keyframe_motions(d) if odometer is not None else NO_MOTIONS
    walk = float(np.radians(settings.odometry_rotation_deg_sqrt_m)), settings.odometry_translation_m_sqrt_m
    if seen is not None and settings.covariance != "fixed":
        walk = believed(walk, seen, *stated(d), settings.gnss.walk_factor)
    motion, covariance = d.keyframe_motions(*walk, _step_covariance(settings, d, wheels.first))
    return [
        Factor("odometry", int(a), int(a) + 1, T, C)
        for a, T, C in zip(d.nodes[:-1], motion, covariance, strict=True)
    ] + [
        Factor("wheel", int(a), int(a) + 1, T, C)
        for a, T, C in zip(d.nodes[wheels.first], wheels.T, wheels.covariance, strict=True)
    ]


def _step_covariance(settings: Settings, d: Drive, by_wheels: I8) -> F8:
    """Covariances (n, 6, 6) of odometry's steps; what scans did not see counts for nothing where wheels tell it."""
    if settings.covariance == "fixed":
        return np.zeros((len(d.odometry), 6, 6))
    covariance = d.step_covariance().copy()
    last = np.searchsorted(d.keyframes, np.arange(len(d.odometry)))
    told = np.isin(last - 1, by_wheels)
    covariance[told] += UNSEEN_STD[:, None] * d.unseen()[told] * UNSEEN_STD
    return covariance


def odometers_of(settings: Settings, drives: Sequence[Drive]) -> dict[str, Odometer]:
    """Gyro and wheels of each session that has them, by its name."""
    if settings.covariance == "fixed":
        return {}
    found: dict[str, list[Drive]] = {}
    for d in drives:
        if len(d.wheel):
            found.setdefault(d.name, []).append(d)
    return {name: Odometer(settings.wheel, parts) for name, parts in found.items()}


def _bridge_factor(bridge: Bridge) -> Factor:
    return Factor(
        "wheel" if bridge.measured else "odometry",
        bridge.node_i,
        bridge.node_j,
        bridge.T_i_j,
        bridge.covariance,
    )


def _gravity_factors(settings: Settings, d: Drive, up: Gravity) -> list[Factor]:
    sigma_deg = settings.gravity_sigma_deg if up.measured else settings.assumed_level_sigma_deg
    covariance = np.diag([np.radians(sigma_deg) ** 2] * 2 + [0.0] * 4)
    return [
        Factor("gravity", int(d.nodes[k]), -1, pose(np.eye(3), u), covariance)
        for k, u in zip(up.keyframe, up.up_lidar, strict=True)
    ]


def _gnss_factors(d: Drive, f: Fixes) -> list[Factor]:
    """One factor per fix on the keyframe nearest in time; odometry carries the antenna from the fix's time to it."""
    if not len(d.gnss):
        return []
    keyframe = d.nearest_keyframe(d.gnss.stamp_ns)
    T_keyframe_fix = inverse(d.odometry.T_odom_lidar[d.keyframes[keyframe]]) @ d.T_odom_lidar_at(
        d.gnss.stamp_ns
    )
    arm = T_keyframe_fix[:, :3, :3] @ d.antenna_m + T_keyframe_fix[:, :3, 3]
    factors = []
    for k in range(len(d.gnss)):
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] = np.diag(f.sigma_m[k] ** 2)
        node = int(d.nodes[keyframe[k]])
        factors.append(
            Factor("gnss", node, -1, pose(np.eye(3), f.world[k]), covariance, str(f.verdict[k]), arm[k])
        )
    return factors


def _loop_factors(settings: Settings, drives: Sequence[Drive], found: Sequence[Link]) -> list[Factor]:
    return [
        Factor(
            "loop", int(drives[k.drive_i].nodes[k.keyframe_i]), int(drives[k.drive_j].nodes[k.keyframe_j]),
            k.T_i_j, k.covariance * settings.loop_inflation**2,
        )
        for k in found
    ]  # fmt: skip
