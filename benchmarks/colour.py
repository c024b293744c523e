"""Colour against the simulator's truth: how far off, where there should be none, and how much of what was seen has some.

    python -m benchmarks.colour                                   drives of three seeds
    python -m benchmarks.colour --sample --seeds                  the embedded sample, with three cameras
    python -m benchmarks.colour --seeds 7 --duration 60 --set margin_px=5 --json -

Each drive is mapped by the workflow, with estimated poses; then `colour` is called as the map calls it, and every point of the map is
held against the albedo of the very LiDAR points that it is the mean of. Which points a camera truly saw is found by casting rays in
the simulator's world, with what moves and the own vehicle in it, from where the cameras truly were.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.colour_truth import Known, known
from benchmarks.colour_world import World
from benchmarks.figures import written
from benchmarks.scores import Figure
from benchmarks.sequences import Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.cameras import Cameras, Images
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed
from scanloom.schemas.session import TruthLog
from scanloom.schemas.tiles import Colours, Piece
from scanloom.schemas.trajectory import Poses, Truth
from scanloom.stages.colour import Settings, brightness, colour
from scanloom.stages.colour.brightness import Settings as Brightness
from scanloom.stages.geometry.srgb import LINEAR, srgb
from scanloom.stages.simulate.settings import Settings as Simulate
from scanloom.stages.tiling.colours import coloured

PRODUCTS = (Images, Cameras, Poses, ObjectTracks, Piece, Truth, Deskewed, FinalLabels, TruthLog)
WORK = Path("build/bench")
PREFIX = "bench.colour"
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
SURE, FULL = 0.99, 0.15
BEYOND_M = 5.0
"""What a camera shows from a little farther than colours are taken from it was seen all the same."""
FITTED = {
    "one": "one factor for all light of the map, fitted to points in full light",
    "each": "one factor for each of red, green, blue, fitted to points in full light",
    "none": "nothing fitted",
}

console = Console(stderr=True, width=200)


def main(words: Sequence[str] | None = None) -> None:
    """Everything the command line asks for."""
    options = _options(words)
    figures: list[Figure] = []
    for scope, chosen in _drives(options).items():
        for figure in _of_drive(scope, chosen, options):
            console.print(
                f"{figure.name:56} {figure.value:10.4g} {figure.unit:4} {figure.method}", highlight=False
            )
            figures.append(figure)
    written(figures, options.json)


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3], help="of town, traffic and noise")
    parser.add_argument(
        "--sample", action="store_true", help="the embedded sample as well, whole, with three cameras"
    )
    parser.add_argument("--duration", type=float, default=25.0, help="length of a drive, s")
    parser.add_argument(
        "--simulate", action="append", default=[], metavar="NAME=VALUE", help="of the simulator"
    )
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of colour")
    parser.add_argument("--store", type=Path, default=WORK / "store", help="store of the drives' products")
    parser.add_argument("--keep", type=Path, help="folder for what was found of every point, as .npz")
    parser.add_argument("--json", default="", help="file for the figures, or - for standard output")
    return parser.parse_args(words)


def _given(words: Sequence[str]) -> dict[str, Any]:
    """`NAME=VALUE` as settings."""
    pairs = (word.partition("=") for word in words)
    return {name: json.loads(value) for name, _, value in pairs}


def _drives(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Settings of the simulator by the drive's name in the figures."""
    given = _given(options.simulate)
    drives: dict[str, dict[str, Any]] = {"sample": {"cameras": 3} | given} if options.sample else {}
    for seed in options.seeds:
        drives[f"seed_{seed}"] = {
            "duration_s": options.duration, "beams": 32, "columns": 1024, "cameras": 3, "standstill_s": 1.0,
            "seed": seed, "town_seed": seed, "parking_seed": seed,
        } | given  # fmt: skip
    return drives


def _of_drive(scope: str, chosen: dict[str, Any], options: argparse.Namespace) -> Iterator[Figure]:
    result = produced(Drive("sample", f"town, {scope}", chosen), PRODUCTS, options.store)
    begun = time.perf_counter()
    settings = Settings(**_given(options.set))
    stretches = list(_painted(result, settings, Simulate(**chosen).readout_s))
    paints = Parts(
        [
            ((("footage", f"{number:04d}"), ("tile", part.key)), part.product)
            for number, parts in enumerate(stretches)
            for part in parts
        ]
    )
    colours = {part.key: part.product for part in brightness(Brightness(), paints)}
    spent_s = time.perf_counter() - begun
    images = sum(len(part) for part in result.parts(Images))
    truth = known(result)
    world = World(Simulate(**chosen), result)
    found = (
        _coloured(truth, colours)
        | {"seams": np.array(list(_seams(stretches)))}
        | {
            "seen": world.seen(truth, settings.reach_m),
            "shown": world.seen(truth, settings.reach_m + BEYOND_M),
        }
        | {"falling": world.falling(truth)}
    )
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(options.keep / f"{scope}.npz", **vars(truth), **found)
    for name, value, unit, method in _scores(truth, found):
        yield Figure(f"{PREFIX}.{scope}.{name}", value, unit, scope, method)
    how = f"wall time of `colour` over {images} images, one process"
    yield Figure(f"{PREFIX}.{scope}.s_per_image", spent_s / images, "s", scope, how)


def _painted(result: Result, settings: Settings, readout_s: float) -> Iterator[list[Any]]:
    """What each stretch of images adds. Of a rolling shutter a log says nothing: a session file does, and so does this."""
    cameras, poses, tracks = (result.parts(product)[0] for product in (Cameras, Poses, ObjectTracks))
    rig = tuple(camera.model_copy(update={"readout_s": readout_s}) for camera in cameras.cameras)
    cameras = cameras.model_copy(update={"cameras": rig})
    pieces = result.parts(Piece)
    for images in result.parts(Images):
        yield list(colour(settings, images, cameras, poses, tracks, pieces))


def _coloured(truth: Known, colours: dict[str, Colours]) -> dict[str, np.ndarray]:
    """Colour (n, 3) and views (n,) of each point, as tiles have them."""
    found = {
        "colour": np.zeros((len(truth.voxel), 3), np.uint8),
        "views": np.zeros(len(truth.voxel), np.uint16),
    }
    for number, name in enumerate(truth.names):
        rows = np.flatnonzero(truth.tile == number)
        there = [colours[name]] if name in colours else []
        for column, values in coloured(truth.voxel[rows], there).items():
            found[column][rows] = values
    return found


def _seams(stretches: list[list[Any]]) -> Iterator[float]:
    """Median ratio of luminance of two neighbouring stretches as `colour` leaves them, where both saw a point, minus 1."""
    for before, after in pairwise(stretches):
        ratios, others = [], {part.key: part.product for part in after}
        for part in before:
            if part.key in others:
                one, other = part.product, others[part.key]
                _, i, j = np.intersect1d(one.voxel, other.voxel, return_indices=True)
                light = (
                    (one.light[i] / one.weight[i, None]) @ LUMINANCE,
                    (other.light[j] / other.weight[j, None]) @ LUMINANCE,
                )
                ratios.append(light[1] / np.maximum(light[0], 1e-9))
        if ratios:
            yield float(np.median(np.concatenate(ratios))) - 1.0


def _scores(truth: Known, found: dict[str, np.ndarray]) -> Iterator[tuple[str, float, str, str]]:
    """Name, value, unit and method of each figure."""
    has, light = found["views"] > 0, LINEAR[found["colour"]]
    sunny = has & (truth.static > SURE) & (truth.lit > SURE)
    surface = truth.normal.any(axis=1)
    full = sunny & surface & (np.abs(found["falling"] @ LUMINANCE - 1.0) < FULL)
    yield "points", float(len(has)), "", "points of the map"
    yield "sunny_points", float(sunny.sum()), "", "static points in the sun that have a colour"
    yield (
        "full_light",
        float(full.sum() / sunny.sum()),
        "",
        f"of these, those in as much light as level ground, within {FULL:.0%}",
    )
    factors = _factors(truth, light, full)
    radiance = truth.albedo * found["falling"]
    for name, rows, target, fitted, what in (
        ("error", full, truth.albedo, "one", "in full light, to albedo"),
        ("error_all", sunny, truth.albedo, "one", "in the sun at any angle, to albedo"),
        ("error_radiance", sunny & surface, radiance, "one", "in the sun at any angle, to albedo times the light that falls there"),
        ("error_radiance_ground", sunny & surface & (truth.ground > SURE), radiance, "one", "ground, to albedo times light"),
        ("error_radiance_standing", sunny & surface & (truth.ground < 1 - SURE), radiance, "one", "standing, to albedo times light"),
        ("error_by_channel", full, truth.albedo, "each", "in full light, to albedo"),
        ("error_as_it_is", full, truth.albedo, "none", "in full light, to albedo"),
    ):  # fmt: skip
        off = _off(light[rows] * factors[fitted], target[rows])
        how = f"static points {what}; mean difference of three sRGB values; {FITTED[fitted]}"
        yield f"{name}_median", float(np.median(off)), "/255", f"median, {how}"
        yield f"{name}_p90", float(np.percentile(off, 90)), "/255", f"90th percentile, {how}"
    yield "factor", float(factors["one"]), "", "the one factor: what the light of the map is multiplied with"
    yield from _presence(has, found["seen"], found["shown"])
    for number, seam in enumerate(found["seams"]):
        how = "how much brighter the next stretch is before `brightness` evens it out, median"
        yield f"seam_{number}", 100.0 * seam, "%", how


def _factors(truth: Known, light: np.ndarray, full: np.ndarray) -> dict[str, Any]:
    """What the light of the map is multiplied with: fitted to the albedo of points in full light."""
    one = np.median((truth.albedo[full] @ LUMINANCE) / (light[full] @ LUMINANCE))
    return {"one": one, "each": np.median(truth.albedo[full] / light[full], axis=0), "none": 1.0}


def _off(light: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(srgb(light).astype(int) - srgb(target).astype(int)).mean(axis=1))


def _presence(has: np.ndarray, seen: np.ndarray, shown: np.ndarray) -> Iterator[tuple[str, float, str, str]]:
    """Colour where there should be some, and where there should be none: `seen` from within reach, `shown` from a little beyond, too."""
    false = float((has & ~shown).sum())
    yield "false_points", false, "", "points with a colour that truly no camera saw"
    yield (
        "false_colour",
        100.0 * false / has.sum(),
        "%",
        "of the points with a colour, those that truly no camera saw",
    )
    yield (
        "unseen_coloured",
        100.0 * false / (~shown).sum(),
        "%",
        "of the points that truly no camera saw, those with a colour",
    )
    yield (
        "coverage",
        100.0 * float((has & seen).sum() / seen.sum()),
        "%",
        "of the points that a camera saw within reach, those with a colour",
    )


if __name__ == "__main__":
    main()
