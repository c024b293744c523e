"""Cleaning against DUFOMap: what stands stays, what passed goes; crispness, localisation and time. `make bench BENCH=clean`.

    python -m benchmarks.clean                                    every scene
    python -m benchmarks.clean --only town_32 --systems dufomap   one scene, one system
    python -m benchmarks.clean --fresh --json -                   times of one run, figures as JSON

Scenes are simulated, or real where `../shared/data` is there. What a system keeps of a scene is remembered until its version
(of ours: the code of the stages) or the scene changes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks import clean_page
from benchmarks.clean_gathering import ESTIMATED
from benchmarks.clean_nearness import F4, Mask
from benchmarks.clean_ours import tracking_ms
from benchmarks.clean_scenes import Scene, places, scene
from benchmarks.clean_scores import (
    Accuracy,
    accuracy,
    by_range,
    is_dynamic,
    is_static,
    kept_in_map,
    may_stand,
)
from benchmarks.clean_systems import OURS, PEER, SYSTEMS, Outcome, System, classify
from benchmarks.clean_utility import entropy_scores, localisation, localisation_scores
from benchmarks.scores import Figure, Score

WORK = Path("build/bench")
PREFIX = "bench.clean"
SEEN_WELL = 500
"""Points of an object that is looked at on its own."""
KEPT_BY = "a point counts as kept with a kept point within 0.05 m"

console = Console(stderr=True, width=200)


def main(words: Sequence[str] | None = None) -> None:
    """Everything the command line asks for."""
    options = _options(words)
    systems = [SYSTEMS[name] for name in options.systems if _there(SYSTEMS[name])]
    figures: list[Figure] = []
    known = places(options.seed)
    for name in options.only or known:
        place = known[name]
        if place.drive.folder is not None and not place.drive.folder.exists():
            console.print(f"{name} is left out: there are no scans at {place.drive.folder}")
            continue
        found = scene(place, options.store, WORK / "clean")
        if options.times:
            figures += _shown(_times(found.first(options.times), place.poses[-1], systems))
            continue
        for poses in place.poses:
            figures += _shown(_of_scene(found, poses, systems, options))
    _write([figure for figure in figures if np.isfinite(figure.value)], options)


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=tuple(places()), default=[], help="only these scenes")
    parser.add_argument("--seed", type=int, default=0, help="of town, traffic and noise of simulated scenes")
    parser.add_argument("--systems", nargs="+", choices=tuple(SYSTEMS), default=tuple(SYSTEMS))
    parser.add_argument("--store", type=Path, default=WORK / "store", help="store of the scenes' products")
    parser.add_argument("--fresh", action="store_true", help="run every system again, for times of one run")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.NAME=VALUE",
        help="a setting of rays, clean or relabel",
    )
    parser.add_argument(
        "--all-variants",
        action="store_true",
        help="every published parameter of DUFOMap, not only the best known",
    )
    parser.add_argument(
        "--times", type=int, default=0, metavar="CHUNKS", help="time alone, of so many chunks of each scene"
    )
    parser.add_argument("--quick", action="store_true", help="accuracy and time alone")
    parser.add_argument("--json", default="", help="file for the figures, or - for standard output")
    parser.add_argument("--page", type=Path, help="page of the documentation whose tables are written anew")
    return parser.parse_args(words)


def _settings(words: Sequence[str]) -> dict[str, dict[str, float]]:
    """`STAGE.NAME=VALUE` as settings by stage."""
    chosen: dict[str, dict[str, float]] = {}
    for word in words:
        name, _, value = word.partition("=")
        stage, _, field = name.partition(".")
        chosen.setdefault(stage, {})[field] = json.loads(value)
    return chosen


def _times(found: Scene, poses: str, systems: Sequence[System]) -> Iterator[Figure]:
    """Time alone, of each system one after the other on the same scans, and of the tracker that ours listens to."""
    for system in systems:
        outcome = classify(system, system.variants[0], found, poses, {}, fresh=True)
        if np.isfinite(outcome.ms_per_scan):
            name = f"{PREFIX}.{found.name}.{system.name}.ms_per_scan"
            how = f"mean wall time of {len(found)} scans, without reading; {outcome.how}"
            yield Figure(name, outcome.ms_per_scan, "ms", found.name, how)
    if any(system.name == OURS for system in systems):
        how = f"mean wall time of {len(found)} scans, one process; boxes that relabel reads"
        yield Figure(
            f"{PREFIX}.{found.name}.{OURS}.objects_ms_per_scan", tracking_ms(found), "ms", found.name, how
        )


def _there(system: System) -> bool:
    if not system.version():
        console.print(f"{system.name} is left out: it is not installed (make bench-setup)")
    return bool(system.version())


def _shown(figures: Iterator[Figure]) -> Iterator[Figure]:
    """The figures, each said on the screen as soon as it is there; how they are made is in the JSON."""
    for figure in figures:
        console.print(f"{figure.name:72} {figure.value:12.5g} {figure.unit}", highlight=False)
        yield figure


def _of_scene(
    found: Scene, poses: str, systems: Sequence[System], options: argparse.Namespace
) -> Iterator[Figure]:
    placed = found.placed(poses)
    everything = np.ones(len(placed), np.bool_)
    before = None if options.quick else localisation(found, poses, everything)
    for system in systems:
        outcome, held = _best(system, found, poses, placed, options)
        scores = [*_accuracy_scores(found, held), *_time(outcome)]
        if before is not None and system.name != "none":
            scores += entropy_scores(placed, outcome.kept, may_stand(found.true_class))
            scores += localisation_scores(before, localisation(found, poses, outcome.kept))
        scope = found.name if poses == ESTIMATED else f"{found.name}_{poses}"
        for score in scores:
            name = f"{PREFIX}.{scope}.{system.name}.{score.name}"
            yield Figure(
                name, score.value, score.unit, scope, f"{score.method}; {outcome.how}; {poses} poses"
            )


def _best(
    system: System, found: Scene, poses: str, placed: F4, options: argparse.Namespace
) -> tuple[Outcome, Mask]:
    """The variant with the highest associated accuracy, and which points of the ground truth its output holds."""
    static, dynamic = is_static(found.true_class), is_dynamic(found.true_class)
    tried = []
    for variant in system.variants if options.all_variants else system.variants[:1]:
        outcome = classify(system, variant, found, poses, _settings(options.set), options.fresh)
        held = kept_in_map(placed, outcome.kept, static | dynamic)
        tried.append((accuracy(static, dynamic, held).merit, outcome, held))
    _, outcome, held = max(tried, key=lambda each: each[0])
    return outcome, held


def _accuracy_scores(found: Scene, held: Mask) -> Iterator[Score]:
    static, dynamic = is_static(found.true_class), is_dynamic(found.true_class)
    yield from _four("", accuracy(static, dynamic, held))
    for ring, part in by_range(found.points, static, dynamic, held):
        yield from _four(f"range_{ring}.", part)
    for kind, numbers in found.kinds.items():
        own = np.isin(found.instance, numbers)
        yield from _four(f"kind_{kind}.", accuracy(static & own, dynamic & own, held))
        yield from _worst(f"kind_{kind}.", found, numbers, held)


def _worst(where: str, found: Scene, numbers: Sequence[int], held: Mask) -> Iterator[Score]:
    """Of the objects of a kind that were seen well, the one that came off worst."""
    static, dynamic = is_static(found.true_class), is_dynamic(found.true_class)
    count = max(numbers, default=0) + 1
    for name, own, good in (("sa", static, held), ("da", dynamic, ~held)):
        points = np.bincount(found.instance[own], minlength=count)[numbers]
        right = np.bincount(found.instance[own & good], minlength=count)[numbers]
        seen = points >= SEEN_WELL
        if seen.sum() > 1:
            how = f"lowest of {seen.sum()} objects with {SEEN_WELL} points and more; {KEPT_BY}"
            yield Score(
                f"{where}worst_{name}_percent", 100.0 * float((right[seen] / points[seen]).min()), "%", how
            )


def _four(where: str, found: Accuracy) -> Iterator[Score]:
    """The figures that there are points for."""
    n = f"{found.static} static, {found.dynamic} dynamic points; {KEPT_BY}"
    if found.static:
        yield Score(f"{where}sa_percent", found.sa, "%", f"static accuracy, {n}")
    if found.dynamic:
        yield Score(f"{where}da_percent", found.da, "%", f"dynamic accuracy, {n}")
    if found.static and found.dynamic:
        yield Score(f"{where}aa_percent", found.aa, "%", f"associated accuracy, {n}")
        yield Score(f"{where}ha_percent", found.ha, "%", f"harmonic accuracy, {n}")


def _time(outcome: Outcome) -> Iterator[Score]:
    if np.isfinite(outcome.ms_per_scan):
        yield Score("ms_per_scan", outcome.ms_per_scan, "ms", "mean wall time, without reading")


def _write(figures: Sequence[Figure], options: argparse.Namespace) -> None:
    text = json.dumps([figure.row() for figure in figures], indent=1)
    for line in clean_page.tables(figures):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    if options.page:
        clean_page.fill(options.page, figures, _remark())
    if options.json == "-":
        print(text)
    elif options.json:
        Path(options.json).write_text(text + "\n")


def _remark() -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    cores = len(os.sched_getaffinity(0))
    peer = SYSTEMS[PEER].version() or "not there"
    return f"Measured at commit {commit or 'unknown'}, {cores} cores, DUFOMap {peer}."


if __name__ == "__main__":
    main()
