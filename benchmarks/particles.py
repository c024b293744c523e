"""Particles: how much of the dust and snow in the air is named, and what of clear air's scenery is taken for such.

`python -m benchmarks.particles [--data FOLDER] [--store FOLDER] [--beams 32 64] [--seeds N ...] [--seconds S] [--scenes NAME ...] [--json -]`
makes simulated drives in snow and dust of three densities and in clear air, and maps each of them by itself, up to the final
labels. Two sets of labels are judged: those of denoise, from a few scans, and the final ones, from the whole map, with
estimated poses. Figures are of each drive, and of all seeds together. With `--data`, the folder that holds `kitti_raw_0005`,
real scans in clear air are labelled, too.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
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
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.product import Product
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass, TruePoints
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
LEAST_SHARE = 1e-4
"""Of points in the air, below which there is nothing to find."""
LEFT_OUT = (int(PointClass.EGO), int(PointClass.OUT_OF_RANGE))


TIMED, REPEATS = 40, 5
"""Scans that denoise is timed on, and how often: the first time its memory is still being asked for."""
JUDGED: dict[str, type[Labels] | type[FinalLabels]] = {"denoise": Labels, "final": FinalLabels}
OF_DENOISE = (Session, Imu, Wheel, SensorCheck)


def main() -> None:
    options = _options()
    figures: list[Figure] = []
    for beams in options.beams:
        for scene in options.scenes:
            figures += simulated(scene, beams, options.seeds, options.seconds, options.store)
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
    parser.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        default=[2, 3, 5],
        help="of town, sensors, traffic and weather; none was fitted to",
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a drive")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--json", default="", help="file, or - for standard output")
    return parser.parse_args()


def simulated(scene: str, beams: int, seeds: list[int], seconds: float, store: Path) -> Iterator[Figure]:
    """Figures of drives with exact truth, one for each seed, and of all of them."""
    total: dict[str, Counter[str]] = {labels: Counter() for labels in JUDGED}
    for seed in seeds:
        name = f"{scene}_{beams}_{seed}"
        of_seed = {"seed": seed, "town_seed": seed, "parking_seed": seed}
        drive = Drive(
            name, name, {**WORLD, **of_seed, "beams": beams, "duration_s": seconds, **SCENES[scene]}
        )
        result = produced(drive, (Deskewed, *OF_DENOISE, TruthLog, Labels, FinalLabels), store)
        truth, material = _truth(result)
        for labels, product in JUDGED.items():
            counts = tally(_classes(result, product), truth, material)
            total[labels] += counts
            yield from _figures(f"{name}.{labels}", name, counts)
        yield _time(result, name, drive.name)
    if len(seeds) > 1:
        for labels, counts in total.items():
            yield from _figures(
                f"{scene}_{beams}.{labels}", f"{scene}, {beams} beams, {len(seeds)} drives", counts
            )


def real(data: Path, store: Path) -> Iterator[Figure]:
    """Shares named in clear air, where there is no truth."""
    if not (data / KITTI).is_dir():
        Console(stderr=True).print(f"{data / KITTI} is not there: no real scans are labelled")
        return
    drive = Drive("kitti_0005", "KITTI raw 0005", folder=data / KITTI)
    result = produced(drive, (Deskewed, *OF_DENOISE, Labels, FinalLabels), store)
    for labels, product in JUDGED.items():
        classes = _classes(result, product)
        for name, value in (("airborne_share", AIRBORNE), ("outlier_share", OUTLIER)):
            share = float(np.mean(classes == value))
            yield Figure(
                f"bench.particles.kitti_0005.{labels}.{name}",
                share,
                "",
                drive.name,
                f"of {len(classes)} points",
            )
    yield _time(result, "kitti_0005", drive.name)


def _time(result: Result, name: str, scope: str) -> Figure:
    """Ms of one core per scan that denoise takes without reading: the median of several times; kernels are compiled before."""
    scans = [scan for _, scan in zip(range(TIMED), _scans(result))]
    rest = [_one(result, product) for product in OF_DENOISE]
    ms = float(np.median([_ms_per_scan(scans, rest) for _ in range(REPEATS)]))
    points = int(np.mean([len(scan) for scan in scans]))
    return Figure(f"bench.particles.{name}.denoise.ms_per_scan", ms, "ms", scope, _how(len(scans), points))


def _ms_per_scan(scans: list[DeskewedScan], rest: list[Any]) -> float:
    for _ in iter(denoise(Settings(), Deskewed(scans[:3]), *rest)):
        pass
    started = time.process_time()
    for _ in iter(denoise(Settings(), Deskewed(scans), *rest)):
        pass
    return 1e3 * (time.process_time() - started) / len(scans)


def tally(found: NDArray[np.uint8], truth: NDArray[np.uint8], material: NDArray[np.uint8]) -> Counter[str]:
    """Numbers of points that are in range and not the own vehicle, by what they are and what they are called."""
    counted = ~np.isin(found, LEFT_OUT) & ~np.isin(truth, LEFT_OUT)
    found, truth, material = found[counted], truth[counted], material[counted]
    air, named, stray = truth == AIRBORNE, found == AIRBORNE, found == OUTLIER
    true = ~air & (truth != OUTLIER)
    sets = {
        "air": air,
        "true": true,
        "standing": true & (truth != PointClass.DYNAMIC),
        "leafy": true & np.isin(material, VEGETATION) & (truth == PointClass.STATIC),
    }
    counts = Counter(all=len(truth), named=int(named.sum()))
    for name, one in sets.items():
        counts[name] = int(one.sum())
        counts[f"{name} named"], counts[f"{name} stray"] = int((one & named).sum()), int((one & stray).sum())
    return counts


def _figures(name: str, scope: str, counts: Counter[str]) -> Iterator[Figure]:
    for figure, value, method in scores(counts):
        yield Figure(f"bench.particles.{name}.{figure}", value, "", scope, method)


def scores(counts: Counter[str]) -> Iterator[tuple[str, float, str]]:
    """Name, value and method of each figure."""
    share = _ratio(counts["air"], counts["all"])
    yield "share", share, f"of {counts['all']} points are in the air"
    if share > LEAST_SHARE:
        precision = _ratio(counts["air named"], counts["named"])
        recall = _ratio(counts["air named"], counts["air"])
        yield "precision", precision, "of the points called airborne"
        yield "recall", recall, "of the points in the air, called airborne"
        yield "f1", 2 * precision * recall / max(precision + recall, 1e-9), "of both"
        yield "removed_recall", _removed("air", counts), "of the same, called airborne or outlier"
    yield "clean_loss", _removed("true", counts), "of the rest that is not stray, airborne or outlier"
    yield "clean_loss_airborne", _ratio(counts["true named"], counts["true"]), "of the same, called airborne"
    yield "standing_loss", _removed("standing", counts), "of the same, if it stands, airborne or outlier"
    yield "vegetation_loss", _removed("leafy", counts), "of trees and bushes, airborne or outlier"
    yield (
        "vegetation_loss_airborne",
        _ratio(counts["leafy named"], counts["leafy"]),
        "of the same, called airborne",
    )


def _removed(what: str, counts: Counter[str]) -> float:
    return _ratio(counts[f"{what} named"] + counts[f"{what} stray"], counts[what])


def _ratio(some: int, of: int) -> float:
    return some / max(of, 1)


def _how(scans: int, points: int) -> str:
    return f"median of {REPEATS} runs over {scans} scans of {points} points, one core, no files; ground and moving things included"


def _one(result: Result, product: type[Product]) -> Any:
    return result.parts(product)[0]


def _scans(result: Result) -> Iterator[DeskewedScan]:
    return (scan for chunk in result.parts(Deskewed) for scan in chunk)


def _classes(result: Result, product: type[Labels] | type[FinalLabels]) -> NDArray[np.uint8]:
    """Classes of all points, in the order of chunks and scans."""
    return np.concatenate([labels.class_ for chunk in result.parts(product) for labels in chunk])


def _truth(result: Result) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    ((_, folder),) = list(result.files(TruthLog))
    true = list(TruePoints.open(next(Path(folder).rglob("points.parquet"))))
    return np.concatenate([each.class_ for each in true]), np.concatenate([each.material for each in true])


if __name__ == "__main__":
    main()
