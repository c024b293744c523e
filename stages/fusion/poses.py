"""Fusion: odometry, loops, GNSS and gravity of all sessions of a map become one consistent set of poses.

Batch pose graph over keyframes (methods 1.8 to 1.10). Every factor, used or not, is reported with a verdict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.errors import StageError
from scanloom.schemas.frames import MAP, WORLD, Georeference
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.fusion.anchoring import Link, anchor, links
from scanloom.stages.fusion.drives import Drive, gather
from scanloom.stages.fusion.factors import Factor, graph_table, whitened_norms
from scanloom.stages.fusion.gnss import Fixes, GnssSettings, judge, screen
from scanloom.stages.fusion.gravity import Gravity, gravity, level
from scanloom.stages.fusion.solving import Solution, interpolate_covariances, marginals, solve
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, se3_log

VERSION = 1


class Settings(BaseModel):
    """How far each kind of measurement is trusted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    odometry_rotation_deg_sqrt_m: float = Field(
        default=0.05,
        gt=0,
        le=10,
        description="random walk of odometry's rotation added per root of distance, deg/sqrt(m)",
    )
    odometry_translation_m_sqrt_m: float = Field(
        default=0.02,
        gt=0,
        le=10,
        description="random walk of odometry's translation added per root of distance, m/sqrt(m)",
    )
    gravity_sigma_deg: float = Field(
        default=1.5, gt=0, le=45, description="standard deviation of a measured up direction, deg"
    )
    assumed_level_sigma_deg: float = Field(
        default=4.0,
        gt=0,
        le=45,
        description="standard deviation of `the vehicle stands level` when there is no IMU, deg",
    )
    gravity_spacing_m: float = Field(
        default=10.0, gt=0, le=1000, description="one gravity factor per this much path, m"
    )
    loop_inflation: float = Field(
        default=1.0, ge=0.1, le=100, description="factor on the standard deviations of loops"
    )
    inlier_probability: float = Field(
        default=0.999,
        gt=0.5,
        lt=1,
        description="chi-square probability up to which a loop or fix is an inlier",
    )
    gnss: GnssSettings = Field(default_factory=GnssSettings, description="gates and weights of GNSS")


def fusion(
    settings: Settings,
    session: Parts[Session],
    odometry: Parts[Odometry],
    loops: Loops,
    gnss: Parts[Gnss],
    imu: Parts[Imu],
    check: Parts[SensorCheck] | None = None,
) -> Iterator[Part[Poses] | Graph]:
    """Optimised poses of every scan, one part per session, then the graph.

    The frame is `world` (east, north, up at the first accepted fix) when at least one session's GNSS tells its place
    and heading, else `map` (z up, origin at the first scan of the first session).

    Raises
    ------
    StageError : a session has no odometry, or nothing ties it to the others.
    """
    drives = list(gather(session, odometry, gnss, imu, check))
    if not drives:
        raise StageError("there is no session to fuse", next_step="add a session to the map")
    ups = [gravity(d, settings.gravity_spacing_m) for d in drives]
    origin, fixes = _place_by_gnss(settings, drives, ups)
    found = links(drives, loops)
    starts = anchor(drives, _placed(drives, ups, fixes), found)
    nodes = np.concatenate([starts[k] @ d.odometry.T_odom_lidar[d.keyframes] for k, d in enumerate(drives)])
    factors = _factors(settings, drives, ups, fixes, found, nodes)
    before = whitened_norms(factors, nodes)
    solution = solve(nodes, factors, settings.inlier_probability)
    covariance = marginals(solution)
    for d in drives:
        yield Part(_poses(d, solution, covariance, origin), d.name)
    yield graph_table(factors, before, whitened_norms(factors, solution.T), _key(drives))


# ------------------------------------------------------------------------------------------------ where sessions stand


def _place_by_gnss(
    settings: Settings, drives: Sequence[Drive], ups: Sequence[Gravity]
) -> tuple[Georeference | None, list[Fixes]]:
    """Fixes of all sessions in the frame `world` of the first session whose GNSS tells its place; else None."""
    verdicts = [screen(settings.gnss, d) for d in drives]
    levels = [level(d, up) for d, up in zip(drives, ups, strict=True)]
    origin: Georeference | None = None
    for d, verdict, R in zip(drives, verdicts, levels, strict=True):
        trial = _judged_at_first_fix(settings, d, verdict, R)
        if trial is not None:
            origin = trial
            break
    judged = []
    for d, verdict, R in zip(drives, verdicts, levels, strict=True):
        at = origin or _first_position(d) or Georeference(
            epsg=0, latitude_deg=0, longitude_deg=0, height_m=0, easting_m=0, northing_m=0, grid_convergence_rad=0,
            point_scale=1,
        )  # fmt: skip
        judged.append(judge(settings.gnss, d, verdict, at, R))
    return origin, judged


def _judged_at_first_fix(settings: Settings, d: Drive, verdict: np.ndarray, R: F8) -> Georeference | None:
    """Georeference at the first fix that enters the graph, when GNSS tells the session's place."""
    passed = np.flatnonzero(verdict == "")
    if not len(passed):
        return None
    provisional = _georeference(d.gnss, int(passed[0]))
    fixes = judge(settings.gnss, d, verdict, provisional, R)
    used = np.flatnonzero(fixes.verdict == "")
    if fixes.alignment is None or not len(used):
        return None
    return _georeference(d.gnss, int(used[0]))


def _first_position(d: Drive) -> Georeference | None:
    finite = (
        np.isfinite(d.gnss.latitude_deg) & np.isfinite(d.gnss.longitude_deg) & np.isfinite(d.gnss.height_m)
    )
    return _georeference(d.gnss, int(np.argmax(finite))) if finite.any() else None


def _georeference(gnss: Gnss, row: int) -> Georeference:
    return georeference(
        float(gnss.latitude_deg[row]), float(gnss.longitude_deg[row]), float(gnss.height_m[row])
    )


def _placed(drives: Sequence[Drive], ups: Sequence[Gravity], fixes: Sequence[Fixes]) -> dict[int, F8]:
    """T_map_odom of the sessions GNSS places; without any, the first session defines the frame `map`."""
    out = {}
    for k, (d, up, f) in enumerate(zip(drives, ups, fixes, strict=True)):
        if f.alignment is not None:
            out[k] = f.alignment.T_world_level @ pose(level(d, up), np.zeros(3))
    if not out:
        out[0] = pose(level(drives[0], ups[0]), np.zeros(3))
    return out


# ------------------------------------------------------------------------------------------------------------- factors


def _factors(
    settings: Settings, drives: Sequence[Drive], ups: Sequence[Gravity], fixes: Sequence[Fixes],
    found: Sequence[Link], nodes: F8,
) -> list[Factor]:  # fmt: skip
    georeferenced = any(f.alignment is not None for f in fixes)
    factors = [_gauge(nodes, georeferenced)]
    for d, up, f in zip(drives, ups, fixes, strict=True):
        factors += _odometry_factors(settings, d)
        factors += _gravity_factors(settings, d, up)
        factors += _gnss_factors(d, f, nodes)
    return factors + _loop_factors(settings, drives, found)


def _gauge(nodes: F8, georeferenced: bool) -> Factor:
    """Prior on the first pose: holds the frame `map`; in `world` it only keeps the system regular."""
    sigma = np.repeat([10.0, 1e4], 3) if georeferenced else np.array([1.0, 1.0, 1e-3, 1e-3, 1e-3, 1e-3])
    R = nodes[0, :3, :3]
    covariance = np.diag(sigma**2)
    covariance[:3, :3] = R.T @ covariance[:3, :3] @ R
    return Factor("prior", 0, -1, nodes[0], covariance)


def _odometry_factors(settings: Settings, d: Drive) -> list[Factor]:
    motion, covariance = d.keyframe_motions(
        float(np.radians(settings.odometry_rotation_deg_sqrt_m)), settings.odometry_translation_m_sqrt_m
    )
    return [
        Factor("odometry", int(a), int(a) + 1, T, C)
        for a, T, C in zip(d.nodes[:-1], motion, covariance, strict=True)
    ]


def _gravity_factors(settings: Settings, d: Drive, up: Gravity) -> list[Factor]:
    sigma_deg = settings.gravity_sigma_deg if up.measured else settings.assumed_level_sigma_deg
    covariance = np.diag([np.radians(sigma_deg) ** 2] * 2 + [0.0] * 4)
    return [
        Factor("gravity", int(d.nodes[k]), -1, pose(np.eye(3), u), covariance)
        for k, u in zip(up.keyframe, up.up_lidar, strict=True)
    ]


def _gnss_factors(d: Drive, f: Fixes, nodes: F8) -> list[Factor]:
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


# -------------------------------------------------------------------------------------------------------------- output


def _poses(d: Drive, solution: Solution, covariance: F8, origin: Georeference | None) -> Poses:
    """Poses of all scans: odometry from the keyframe before, plus its share of the correction up to the next one."""
    rows = d.keyframes
    keyframe = np.zeros(len(d.odometry), bool)
    keyframe[rows] = True
    return Poses(
        scan_index=d.odometry.scan_index.copy(),
        stamp_ns=d.odometry.stamp_ns.copy(),
        T_world_lidar=_spread(d, solution.T[d.nodes]),
        covariance=interpolate_covariances(
            d.odometry.stamp_ns[rows], covariance[d.nodes], d.odometry.stamp_ns
        ),
        keyframe=keyframe,
        frame=WORLD if origin else MAP,
        georeference=origin.model_dump() if origin else None,
    )


def _spread(d: Drive, T_keyframes: F8) -> F8:
    """T = T_a (O_a^-1 O) Exp(s xi), with xi what the motion to the next keyframe lacks and s the share of time."""
    odom, rows = d.odometry.T_odom_lidar, d.keyframes
    every = np.arange(len(odom))
    a = np.clip(np.searchsorted(rows, every, side="right") - 1, 0, len(rows) - 1)
    T = T_keyframes[a] @ inverse(odom[rows[a]]) @ odom
    if len(rows) > 1:
        xi = se3_log(inverse(T_keyframes[:-1] @ inverse(odom[rows[:-1]]) @ odom[rows[1:]]) @ T_keyframes[1:])
        at = np.minimum(a, len(rows) - 2)
        stamp = d.odometry.stamp_ns
        span = np.maximum(stamp[rows[at + 1]] - stamp[rows[at]], 1)
        share = np.where(a == at, np.clip((stamp - stamp[rows[at]]) / span, 0.0, 1.0), 0.0)
        T = T @ se3_exp(share[:, None] * xi[at])
    T[rows] = T_keyframes
    return np.asarray(T)


def _key(drives: Sequence[Drive]) -> Callable[[int], str]:
    starts = np.array([d.first_node for d in drives])

    def name(node: int) -> str:
        d = drives[int(np.searchsorted(starts, node, side="right")) - 1]
        return d.key(node - d.first_node)

    return name
