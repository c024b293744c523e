"""Particles: how much of the dust and snow in the air denoise names, and what of clear air's scenery it takes for such.

`python -m benchmarks.particles [--data FOLDER] [--store FOLDER] [--beams 32 64] [--seed N] [--seconds S] [--scenes NAME ...] [--json -]`
makes short simulated drives in snow and dust of three densities and in clear air, and labels them. With `--data`, the folder
that holds `kitti_raw_0005`, real scans in clear air are labelled, too.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.figures import published
from benchmarks.scores import Figure
from benchmarks.sequences import Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.product import Product
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, TruePoints
from scanloom.schemas.session import Session, TruthLog
from scanloom.schemas.tracks import Imu, Wheel
from scanloom.stages.denoise import Settings, denoise
from scanloom.stages.simulate.meshes import Material

SCENES: dict[str, dict[str, Any]] = {
    "clear": {},
    "snow_light": {"snow_per_m": 0.0006},
    "snow_middle": {"snow_per_m": 0.0035},
    "snow_heavy": {"snow_per_m": 0.012},
    "dust_light": {"dust_clouds": 0.4},
    "dust_middle": {"dust_clouds": 0.8},
    "dust_heavy": {"dust_clouds": 2.0},
}
WORLD = {"start_m": 300.0, "standstill_s": 0.5, "dust_per_m": 0.0}
VEGETATION = (Material.GRASS, Material.BARK, Material.LEAF)
KITTI = "kitti_raw_0005"
AIRBORNE, OUTLIER = int(PointClass.AIRBORNE), int(PointClass.OUTLIER)
LEFT_OUT = (int(PointClass.EGO), int(PointClass.OUT_OF_RANGE))


def main() -> None:
    options = _options()
    figures: list[Figure] = []
    for beams in options.beams:
        for scene in options.scenes:
            figures += simulated(scene, beams, options.seed, options.seconds, options.store)
    if options.data is not None:
        figures += real(options.data, options.store)
    published(figures, options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help=f"folder that holds {KITTI}")
    parser.add_argument("--store", type=Path, default=Path("build/particles"), help="folder of what is made")
    parser.add_argument("--beams", type=int, nargs="+", default=[32, 64])
    parser.add_argument("--seed", type=int, default=2, help="of town, sensors, traffic and weather")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a drive")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--json", default="", help="file, or - for standard output")
    return parser.parse_args()


def simulated(scene: str, beams: int, seed: int, seconds: float, store: Path) -> Iterator[Figure]:
    """Figures of one drive with exact truth."""
    name = f"{scene}_{beams}_{seed}"
    seeds = {"seed": seed, "town_seed": seed, "parking_seed": seed}
    drive = Drive(name, name, {**WORLD, **seeds, "beams": beams, "duration_s": seconds, **SCENES[scene]})
    result = produced(drive, (Deskewed, Session, Imu, Wheel, SensorCheck, TruthLog), store)
    scans = _scans(result)
    classes, ms = labelled(result, scans)
    truth, material = _truth(result)
    for row in scores(classes, truth, material):
        yield Figure(f"bench.particles.{name}.{row[0]}", row[1], row[2], name, row[3])
    points = int(np.mean([len(scan) for scan in scans]))
    yield Figure(f"bench.particles.{name}.ms_per_scan", ms, "ms", name, _how(points))


def real(data: Path, store: Path) -> Iterator[Figure]:
    """Shares named in clear air, where there is no truth."""
    if not (data / KITTI).is_dir():
        Console(stderr=True).print(f"{data / KITTI} is not there: no real scans are labelled")
        return
    drive = Drive("kitti_0005", "KITTI raw 0005", folder=data / KITTI)
    result = produced(drive, (Deskewed, Session, Imu, Wheel, SensorCheck), store)
    scans = _scans(result)
    classes, ms = labelled(result, scans)
    for name, value in (("airborne_share", AIRBORNE), ("outlier_share", OUTLIER)):
        share = float(np.mean(classes == value))
        yield Figure(f"bench.particles.kitti_0005.{name}", share, "", drive.name, f"of {len(classes)} points")
    points = int(np.mean([len(scan) for scan in scans]))
    yield Figure("bench.particles.kitti_0005.ms_per_scan", ms, "ms", drive.name, _how(points))


def labelled(result: Result, scans: list[DeskewedScan]) -> tuple[NDArray[np.uint8], float]:
    """Classes of all points, and ms of one core per scan without reading; kernels are compiled before."""
    rest = [_one(result, product) for product in (Session, Imu, Wheel, SensorCheck)]
    for _ in iter(denoise(Settings(), Deskewed(scans[:3]), *rest)):
        pass
    started = time.process_time()
    classes = [labels.class_ for labels in iter(denoise(Settings(), Deskewed(scans), *rest))]
    return np.concatenate(classes), 1e3 * (time.process_time() - started) / len(scans)


Row = tuple[str, float, str, str]


def scores(found: NDArray[np.uint8], truth: NDArray[np.uint8], material: NDArray[np.uint8]) -> Iterator[Row]:
    """Of points that are in range and not the own vehicle."""
    counted = ~np.isin(found, LEFT_OUT) & ~np.isin(truth, LEFT_OUT)
    found, truth, material = found[counted], truth[counted], material[counted]
    air, named = truth == AIRBORNE, found == AIRBORNE
    removed = named | (found == OUTLIER)
    yield "share", float(air.mean()), "", f"of {len(truth)} points are in the air"
    if air.mean() > 1e-4:
        precision, recall = _ratio(air & named, named), _ratio(air & named, air)
        yield "precision", precision, "", "of the points called airborne"
        yield "recall", recall, "", "of the points in the air, called airborne"
        yield "f1", 2 * precision * recall / max(precision + recall, 1e-9), "", "of both"
        yield "removed_recall", _ratio(air & removed, air), "", "of the same, called airborne or outlier"
    true = ~air & (truth != OUTLIER)
    yield "clean_loss", _ratio(true & removed, true), "", "of the rest that is not stray, airborne or outlier"
    yield "clean_loss_airborne", _ratio(true & named, true), "", "of the same, called airborne"
    moving = truth == PointClass.DYNAMIC
    yield "standing_loss", _ratio(true & ~moving & removed, true & ~moving), "", "of the same, if it stands"
    leafy = true & np.isin(material, VEGETATION) & (truth == PointClass.STATIC)
    yield "vegetation_loss", _ratio(leafy & removed, leafy), "", "of trees and bushes, airborne or outlier"
    yield "vegetation_loss_airborne", _ratio(leafy & named, leafy), "", "of the same, called airborne"


def _ratio(some: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(some.sum() / max(of.sum(), 1))


def _how(points: int) -> str:
    return f"mean of all scans, {points} points each, one core, no files; ground and moving things included"


def _one(result: Result, product: type[Product]) -> Any:
    return result.parts(product)[0]


def _scans(result: Result) -> list[DeskewedScan]:
    return [scan for chunk in result.parts(Deskewed) for scan in chunk]


def _truth(result: Result) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    ((_, folder),) = list(result.files(TruthLog))
    true = list(TruePoints.open(next(Path(folder).rglob("points.parquet"))))
    return np.concatenate([each.class_ for each in true]), np.concatenate([each.material for each in true])


if __name__ == "__main__":
    main()
