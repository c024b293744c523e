"""Evaluation: every figure that says how far to trust a map."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.evaluation import ErrorTrack, Metrics
from scanloom.schemas.loops import Loops
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import Tile
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.evaluation.crispness import map_figures
from scanloom.stages.evaluation.figures import Figure, to_metrics
from scanloom.stages.evaluation.revisits import loop_figures, true_path
from scanloom.stages.evaluation.sensors import sensor_figures
from scanloom.stages.evaluation.trajectories import error_track, trajectory_figures, truth_figures

VERSION = 1


class Settings(BaseModel):
    """What counts as a true loop, and how the entropy of the map is sampled."""

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
    entropy_samples: int = Field(
        20_000, ge=100, le=1_000_000, description="points of the map at which entropy is taken"
    )
    seed: int = Field(0, ge=0, description="of the choice of these points")


def evaluation(
    settings: Settings,
    session: Parts[Session],
    truth: Parts[Truth],
    odometry: Parts[Odometry],
    poses: Parts[Poses],
    loops: Loops,
    tiles: Parts[Tile],
    check: Parts[SensorCheck] | None = None,
) -> Iterator[Part[ErrorTrack] | Metrics]:
    """Yield the error track of every session with truth, then the metrics of all sessions and of the map.

    What needs truth is left out where there is none.
    """
    truths = {c["session"]: t for c, t in truth.items() if len(t)}
    odometries = {c["session"]: o for c, o in odometry.items()}
    optimised = {c["session"]: p for c, p in poses.items()}
    checks = {c["session"]: found for c, found in check.items()} if check is not None else {}
    figures: list[Figure] = []
    for name in sorted(odometries.keys() & optimised.keys()):
        figures += _of(name, trajectory_figures(odometries[name], optimised[name]))
        if name in checks:
            figures += _of(name, sensor_figures(checks[name]))
        if name in truths:
            figures += _of(name, truth_figures(truths[name], odometries[name], optimised[name]))
            track = error_track(truths[name], odometries[name], optimised[name])
            if track is not None:
                yield Part(track, name)
    paths = {name: true_path(t, odometries[name]) for name, t in truths.items() if name in odometries}
    figures += loop_figures(loops, paths, settings.loop_error_m, settings.loop_error_deg)
    figures.append(_georeferenced(optimised))
    figures += map_figures(
        tiles, settings.entropy_radii_m, settings.entropy_neighbours, settings.entropy_samples, settings.seed
    )
    yield to_metrics(figures)


def _of(session: str, figures: Iterator[Figure]) -> list[Figure]:
    return [Figure(f.name, f.value, f.unit, f.method, "session", session) for f in figures]


def _georeferenced(poses: dict[str, Poses]) -> Figure:
    georeferenced = bool(poses) and all(p.georeference is not None for p in poses.values())
    return Figure(
        "fusion.georeferenced", float(georeferenced), "", "1 when the map has a place on the Earth", "map"
    )
