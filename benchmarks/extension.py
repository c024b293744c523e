"""Extension of the sample by its second session: how well the two days fit, what stays, which parked cars are gone.

`python -m benchmarks.extension [--store FOLDER] [--mode rigid|soft] [--json -]` maps the sample, extends it by `sample2`
and holds the new version against the truth of the simulator. What is in the store already is not made again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.figures import published
from benchmarks.parking import bays, gone_scores
from benchmarks.scores import Figure
from benchmarks.surfaces import plane_distances
from scanloom.pipeline.run import Result
from scanloom.schemas.base import Base
from scanloom.schemas.changes import Changes
from scanloom.schemas.tiles import Piece
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.changes.points import standing_points
from scanloom.stages.evaluation.paths import true_paths
from scanloom.stages.evaluation.sessions import between
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8
from scanloom.workflows.build_map import Order, Outcome, build_map
from scanloom.workflows.delivery import read_map
from scanloom.workflows.extend_map import extension_order
from scanloom.workflows.parent import read_parent

OLD, NEW = "sample", "sample2"


def main() -> None:
    options = _options()
    folder = options.store
    first = _made(Order((OLD,), folder / "maps" / OLD, OLD, folder / "store", workers=options.workers))
    parent = read_parent(first.out)
    order = extension_order(
        parent, [NEW], out=folder / "maps" / f"{OLD}-{options.mode}-{options.seed}", store=folder / "store",
        mode=options.mode, project={}, command_line={"simulate": _second_day(options)}, workers=options.workers,
    )  # fmt: skip
    second = _made(order)
    figures = list(_figures(first, second, options.mode, options.seed))
    published(figures, options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="not used: the sample needs no data")
    parser.add_argument(
        "--store", type=Path, default=Path("build/extension"), help="folder of store and maps"
    )
    parser.add_argument("--mode", choices=("rigid", "soft"), default="rigid")
    parser.add_argument("--workers", type=int)
    parser.add_argument(
        "--seed", type=int, default=1, help="of the second day: sensors, traffic and parked cars"
    )
    parser.add_argument("--start", type=float, help="where on the lap the second day starts, m")
    parser.add_argument("--length", type=float, help="how long the second day's drive takes, s")
    parser.add_argument("--json", default="", help="file, or - for standard output")
    return parser.parse_args()


def _second_day(options: argparse.Namespace) -> dict[str, float]:
    """What is changed of the second session."""
    told = {"start_m": options.start, "duration_s": options.length}
    changed = {name: value for name, value in told.items() if value is not None}
    return changed if options.seed == 1 else {"seed": options.seed, "parking_seed": options.seed, **changed}


def _made(order: Order) -> Outcome:
    outcome = build_map(order)
    for _, error in outcome.failures:
        raise error
    return outcome


def _figures(first: Outcome, second: Outcome, mode: str, day: int) -> Iterator[Figure]:
    if second.result is None:
        return
    result = second.result

    def figure(name: str, value: float, unit: str, method: str) -> Figure:
        return Figure(f"extension.{name}", float(value), unit, mode, method)

    yield from (figure(*row) for row in _fit(result))
    yield from (figure(*row) for row in _kept(first, second))
    yield from (figure(*row) for row in _cars(result, day))
    yield figure("changes.points", sum(map(len, result.parts(Changes))), "", "points reported as gone")
    yield figure("tasks.executed", second.executed, "", f"of {len(result.tasks)} tasks of the extension")


Row = tuple[str, float, str, str]


def _fit(result: Result) -> Iterator[Row]:
    """How the new session lies on the old map: by its surfaces, without truth, and by true poses."""
    d = plane_distances(result.parts(Piece), OLD, NEW)
    how = (
        f"of {len(d)} standing and ground points of the new session to the plane of the old map's around them"
    )
    yield "static_error_m", float(np.median(np.abs(d))), "m", f"median distance {how}"
    yield "static_error_p90_m", float(np.percentile(np.abs(d), 90)), "m", f"90th percentile {how}"
    poses = {where["session"]: part for where, part in result.parts(Poses).items()}
    truths = {where["session"]: part for where, part in result.parts(Truth).items()}
    odometry = {where["session"]: part for where, part in result.parts(Odometry).items()}
    paths = true_paths(truths, odometry)
    errors = between(paths[OLD], poses[OLD], paths[NEW], poses[NEW])
    how = f"error of a new keyframe's pose in the nearest old one, by truth, {len(errors)} places within 5 m"
    yield "pose_error_rmse_m", alignment.rms(errors[:, 0]), "m", f"rms {how}"
    yield "pose_error_max_m", float(errors[:, 0].max()), "m", f"largest {how}"
    yield "pose_error_rmse_deg", alignment.rms(np.degrees(errors[:, 1])), "deg", f"rms {how}"


def _kept(first: Outcome, second: Outcome) -> Iterator[Row]:
    """What of the old map came through byte by byte."""
    if second.result is None:
        return
    before, after = read_map(first.out)["files"], read_map(second.out)["files"]
    met = {dict(where)["tile"] for where, _ in second.result.files(Piece) if dict(where)["session"] == NEW}
    old = {Path(name).stem for name in before if name.startswith("tiles/") and name != "tiles/index.parquet"}
    apart = sorted(old - met)
    same = [all(before[f] == after.get(f) for f in _files(tile)) for tile in apart]
    yield (
        "tiles.identical_share", float(np.mean(same)) if same else float("nan"), "",
        f"of the {len(apart)} old tiles without a point of the new session, byte by byte",
    )  # fmt: skip
    yield "tiles.out_of_reach", len(apart), "", f"of {len(old)} old tiles"
    poses = {where["session"]: part.poses() for where, part in second.result.parts(Base).items() if len(part)}
    new = {where["session"]: part for where, part in second.result.parts(Poses).items()}
    moved = np.linalg.norm(new[OLD].T_world_lidar[:, :3, 3] - poses[OLD].T_world_lidar[:, :3, 3], axis=1)
    yield "poses.moved_max_m", float(moved.max()), "m", "farthest that a pose of the old session moved"
    yield "poses.identical_share", float(np.mean(moved == 0.0)), "", "of the old session's poses"


def _files(tile: str) -> tuple[str, str]:
    return f"tiles/{tile}.parquet", f"tiles/{tile}.ply"


def _cars(result: Result, day: int) -> Iterator[Row]:
    """Parked cars that left, by the simulator's own lists of cars."""
    changes = result.parts(Changes)[0]
    points = np.column_stack((changes.x_m, changes.y_m, changes.z_m))
    poses = {where["session"]: part for where, part in result.parts(Poses).items()}
    truths = {where["session"]: part for where, part in result.parts(Truth).items()}
    T_town_map = _T_town_map(truths[OLD], poses[OLD])
    in_town = points @ T_town_map[:3, :3].T + T_town_map[:3, 3]
    new_path = (T_town_map @ poses[NEW].T_world_lidar)[:, :3, 3]
    asked = _asked(result, T_town_map)
    scores = gone_scores(bays(second_day=day), in_town, changes.object_, asked, new_path)
    yield (
        "cars.left",
        scores.left,
        "",
        "cars of the first day whose place is empty on the second, in reach of it",
    )
    yield "cars.found", scores.found, "", "of these, with at least a third of their points reported"
    yield "cars.recall", scores.found / max(scores.left, 1), "", "cars found of those that left"
    yield "cars.objects", scores.objects, "", "objects reported, but for those in a bay that another car took"
    yield "cars.true_objects", scores.true, "", "of these, with most of their points in a car that left"
    yield "cars.precision", scores.true / max(scores.objects, 1), "", "objects that are a car that left"
    yield "cars.point_precision", scores.true_points, "", "reported points in a car that left or was replaced"


def _asked(result: Result, T_town_map: F8) -> F8:
    """Standing points (n, 3) of the old map in the town's frame."""
    tiles = result.parts(Piece).by("tile")
    old = [
        standing_points(tile, [piece for where, piece in parts.items() if where["session"] == OLD], 0.2, 0.3)
        for tile, parts in tiles.items()
        if any(where["session"] == OLD for where in parts.coordinates())
    ]
    points = np.concatenate(old)
    return np.asarray(points @ T_town_map[:3, :3].T + T_town_map[:3, 3])


def _T_town_map(truth: Truth, poses: Poses) -> F8:
    """The map in the town, by the old session's true poses at its scans."""
    covered = inside(truth.stamp_ns, poses.stamp_ns)
    true = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, poses.stamp_ns[covered])
    return alignment.umeyama(true[:, :3, 3], poses.T_world_lidar[covered][:, :3, 3])


if __name__ == "__main__":
    main()
