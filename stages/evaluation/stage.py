"""Evaluation: every figure that says how far to trust a map.

Truth is used here alone, and only where there is some:

* `odometry.*`, `fusion.*`: absolute error after one rigid alignment, relative errors, KITTI's drift;
  `fusion.absolute_rmse_m` with nothing aligned where truth and map both stand on the Earth;
  `fusion.nees_translation`, squared error over marginal covariance: 3 is honest, more is too sure.
* `fusion.inter_session_rmse_m`: error of the keyframes of one session in the nearest ones of another, where both pass
  within 5 m and their truths share a frame.
* `loops.accepted`: loops that the graph uses, of the `loops.verified` that passed the geometric tests; precision is the
  share of true ones. `loops.recall`: keyframes that come within 4 m of a place left 50 m of path and 30 s before, or seen
  in an earlier session, and have a true loop in use within 10 m of path.
* `loops.search_rN_*`: the search alone, over thresholds of the descriptor's distance. A candidate is right when its two
  scans lie within N m (3, 4, 5, 10); recall is that of the keyframes as above, with right candidates in place of loops.
* `gnss.wrong_fixes`: fixes off by more than 1 m and five times what their receiver claims; `gnss.wrong_used`: those of them
  that the graph uses; `gnss.used_error_*`: what the fixes in use are truly off by.

Without truth: `odometry.degenerate_*`, where a direction was not seen beyond noise; `gnss.*`, what became of the fixes by
the receiver's own status and how far they lie from the antenna of the finished map; `sensors.*`; `clean.*`, how many
points were left out of the map and why, and the entropy at the same points with them and without; and of the map itself:

* `map.mme_*`, mean map entropy, and `map.mpv_*`, mean plane variance: how crisp it is.
* `map.wall_*`: how thick upright surfaces are, and how many of them are doubled, as walls are when two passes do not fit.
* `map.overlap_*`: how much of it was met again on a later pass, or by another session.
* `map.ground_density_*`, `map.surface_density_*`: points per square metre of the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import CameraCheck
from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.evaluation import ErrorTrack, Metrics
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts, ProductT
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.evaluation.crispness import map_figures
from scanloom.stages.evaluation.degenerate import degeneracy_figures
from scanloom.stages.evaluation.figures import Figure, to_metrics
from scanloom.stages.evaluation.fixes import fix_figures, true_fix_figures
from scanloom.stages.evaluation.loops import judged, loop_figures
from scanloom.stages.evaluation.paths import TruePath, true_paths
from scanloom.stages.evaluation.removed import count_figures
from scanloom.stages.evaluation.revisits import revisits
from scanloom.stages.evaluation.search import search_figures
from scanloom.stages.evaluation.sensors import camera_figures, sensor_figures
from scanloom.stages.evaluation.sessions import session_figures
from scanloom.stages.evaluation.survey import Manner
from scanloom.stages.evaluation.trajectories import error_track, trajectory_figures, truth_figures
from scanloom.stages.geometry.factor_rows import FixRows, fix_rows

VERSION = 2


class Settings(BaseModel):
    """What counts as a true loop, and how closely the map is looked at."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    loop_error_m: float = Field(0.5, gt=0.0, le=10.0, description="a loop within this of truth is true, m")
    loop_error_deg: float = Field(
        2.0, gt=0.0, le=45.0, description="a loop within this of truth is true, deg"
    )
    entropy_radii_m: tuple[float, float, float] = Field(
        (0.3, 0.5, 1.0), description="radii of mean map entropy, increasing, m"
    )
    entropy_neighbours: int = Field(
        6, ge=4, le=1000, description="points a neighbourhood needs, the point itself included"
    )
    samples_per_tile: int = Field(
        1000,
        ge=10,
        le=1_000_000,
        description="points of a tile around which the map is looked at closely, at most",
    )
    wall_gap_m: tuple[float, float] = Field(
        (0.05, 0.4), description="least and largest distance of the layers of a double wall, m"
    )


def evaluation(
    settings: Settings,
    session: Parts[Session],
    truth: Parts[Truth],
    odometry: Parts[Odometry],
    poses: Parts[Poses],
    loops: Loops,
    graph: Graph,
    gnss: Parts[Gnss],
    tiles: Parts[Tile],
    check: Parts[SensorCheck] | None = None,
    counts: Parts[ClassCounts] | None = None,
    removed: Parts[RemovedTile] | None = None,
    cameras: Parts[CameraCheck] | None = None,
) -> Iterator[Part[ErrorTrack] | Metrics]:
    """Yield the error track of every session with truth, then the metrics of all sessions and of the map.

    What needs truth is left out where there is none.
    """
    given = _Given(
        _by_session(truth), _by_session(odometry), _by_session(poses), _by_session(gnss), _by_session(check)
    )
    truths = {name: t for name, t in given.truths.items() if len(t)}
    fixes = fix_rows(graph)
    by_name = {} if counts is None else counts.by("session")
    cameras_of = _by_session(cameras)
    figures: list[Figure] = []
    for name in sorted(given.odometries.keys() & given.poses.keys()):
        figures += _of(name, _session_figures(name, given, fixes))
        figures += _of(name, count_figures(by_name.get(name, ())))
        figures += _of(name, camera_figures(cameras_of.get(name, CameraCheck())))
        if name in truths:
            track = error_track(truths[name], given.odometries[name], given.poses[name])
            if track is not None:
                yield Part(track, name)
    paths = true_paths(truths, given.odometries)
    figures += _loop_figures(settings, loops, graph, paths)
    figures += session_figures(paths, given.poses)
    figures.append(_georeferenced(given.poses))
    figures += map_figures(tiles, removed, given.poses, _manner(settings))
    yield to_metrics(figures)


def _manner(settings: Settings) -> Manner:
    return Manner(
        settings.samples_per_tile, settings.entropy_radii_m, settings.entropy_neighbours, settings.wall_gap_m
    )


@dataclass(frozen=True)
class _Given:
    """Products of each session by its name."""

    truths: dict[str, Truth]
    odometries: dict[str, Odometry]
    poses: dict[str, Poses]
    gnss: dict[str, Gnss]
    checks: dict[str, SensorCheck]


def _session_figures(name: str, given: _Given, fixes: dict[str, FixRows]) -> Iterator[Figure]:
    odometry, poses = given.odometries[name], given.poses[name]
    yield from trajectory_figures(odometry, poses)
    yield from degeneracy_figures(odometry)
    if name in given.checks:
        yield from sensor_figures(given.checks[name])
    if name in fixes and name in given.gnss:
        yield from fix_figures(given.gnss[name], fixes[name], poses.georeference is not None)
    if name in given.truths and len(given.truths[name]):
        yield from truth_figures(given.truths[name], odometry, poses)
        if name in fixes and name in given.gnss:
            yield from true_fix_figures(given.gnss[name], fixes[name], poses, given.truths[name])


def _loop_figures(
    settings: Settings, loops: Loops, graph: Graph, paths: dict[str, TruePath]
) -> Iterator[Figure]:
    judgement, back = judged(loops, paths), revisits(paths)
    true = judgement.right(settings.loop_error_m, settings.loop_error_deg)
    yield from loop_figures(loops, graph, judgement, true, paths, back)
    yield from search_figures(loops, judgement, paths, back)


def _by_session(parts: Parts[ProductT] | None) -> dict[str, ProductT]:
    return {} if parts is None else {c["session"]: product for c, product in parts.items()}


def _of(session: str, figures: Iterator[Figure]) -> list[Figure]:
    return [Figure(f.name, f.value, f.unit, f.method, "session", session) for f in figures]


def _georeferenced(poses: dict[str, Poses]) -> Figure:
    georeferenced = bool(poses) and all(p.georeference is not None for p in poses.values())
    return Figure(
        "fusion.georeferenced", float(georeferenced), "", "1 when the map has a place on the Earth", "map"
    )
