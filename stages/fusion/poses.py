"""Fusion: odometry, loops, GNSS and gravity of all sessions of a map become one consistent set of poses.

Batch pose graph over keyframes (methods 1.8 to 1.10). Every factor, used or not, is reported with a verdict.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby

import numpy as np

from scanloom.schemas.base import Base
from scanloom.schemas.errors import StageError
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tracks import Gnss, Imu, Wheel
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.fusion.anchoring import anchor
from scanloom.stages.fusion.assembly import assembled, odometers_of
from scanloom.stages.fusion.base import BaseMap, base_map
from scanloom.stages.fusion.bridging import bridges, guessed
from scanloom.stages.fusion.drives import Drive, gather
from scanloom.stages.fusion.extending import final, held, on_base, on_ties
from scanloom.stages.fusion.factors import graph_table, position_residuals, whitened_norms
from scanloom.stages.fusion.gnss import contradictions, refusals
from scanloom.stages.fusion.gravity import gravity
from scanloom.stages.fusion.links import links
from scanloom.stages.fusion.placing import place_by_gnss, placed
from scanloom.stages.fusion.settings import Settings
from scanloom.stages.fusion.solving import solve
from scanloom.stages.fusion.spreading import poses_of
from scanloom.stages.fusion.tuning import tuned
from scanloom.stages.fusion.untied import ONE_LOOP, Untied, hanging_on_one, left_out, loops_among, those_tied

__all__ = ["VERSION", "Settings", "fusion"]

VERSION = 1


def fusion(
    settings: Settings,
    session: Parts[Session],
    odometry: Parts[Odometry],
    loops: Loops,
    gnss: Parts[Gnss],
    imu: Parts[Imu],
    wheel: Parts[Wheel] | None = None,
    check: Parts[SensorCheck] | None = None,
    base: Parts[Base] | None = None,
) -> Iterator[Part[Poses] | Graph]:
    """Optimised poses of every scan, one part per session, then the graph.

    The frame is `world` (east, north, up at the first accepted fix) when at least one session's GNSS tells its place
    and heading, else `map` (z up, origin at the first scan of the first session). Of a map that is extended it stays.
    A session that nothing ties to the others is left out with a warning.

    Raises
    ------
    StageError : a session has no odometry, or sessions of which none has a place are not tied to each other.
    """
    drives = list(gather(session, odometry, gnss, imu, wheel, check))
    if not drives:
        raise StageError("there is no session to fuse", next_step="add a session to the map")
    old = base_map(base)
    try:
        yield from _fused(settings, drives, loops, old)
    except Untied as lost:
        new = old.new_among(d.name for d in drives) if old else frozenset[str]()
        rest = those_tied(drives, links(drives, loops), lost, new)
        yield from _fused(settings, rest, loops_among(rest, loops), old, left_out(drives, rest))


def _fused(
    settings: Settings, drives: Sequence[Drive], loops: Loops, old: BaseMap | None, warned: Sequence[str] = ()
) -> Iterator[Part[Poses] | Graph]:
    """Poses of these drives, one part per session, then the graph."""
    ups = [gravity(d, settings.gravity_spacing_m) for d in drives]
    drives, told = tuned(settings.gnss, drives, ups)
    odometers = odometers_of(settings, drives)
    gaps = bridges(drives, odometers)
    origin, fixes = place_by_gnss(settings, drives, ups, old)
    found = links(drives, loops)
    anchored, fixed = on_base(drives, old)
    known = placed(drives, ups, fixes, fixed)
    starts = anchor(anchored, known, found, gaps, anywhere=bool(origin or old))
    nodes = np.concatenate([starts[k] @ d.odometry.T_odom_lidar[d.keyframes] for k, d in enumerate(anchored)])
    factors = assembled(settings, drives, ups, fixes, found, gaps, odometers, nodes)
    factors = held(settings, factors, drives, old)
    before = whitened_norms(factors, nodes)
    try:
        solution = solve(nodes, factors, settings.inlier_probability, settings.consistency)
    except StageError as error:
        lone = hanging_on_one(drives, found, known)
        if not lone:
            raise
        raise Untied.of(lone, anywhere=bool(origin or old), loops=ONE_LOOP) from error
    for name, segments in groupby(drives, key=lambda d: d.name):
        solved = Poses.concatenate([poses_of(d, solution, origin) for d in segments])
        yield Part(final(settings, name, solved, old), name)
    warnings = [*warned, *refusals(drives, fixes), *guessed(drives, gaps, found, fixes)]
    warnings += on_ties(drives, fixes, factors, old)
    after = whitened_norms(factors, solution.T)
    residual_m = position_residuals(factors, solution.T)
    table = graph_table(factors, before, after, residual_m, _key(drives))
    yield dataclasses.replace(table, remarks=[*told, *contradictions(drives, fixes)], warnings=warnings)


def _key(drives: Sequence[Drive]) -> Callable[[int], str]:
    starts = np.array([d.first_node for d in drives])

    def name(node: int) -> str:
        d = drives[int(np.searchsorted(starts, node, side="right")) - 1]
        return d.key(node - d.first_node)

    return name
