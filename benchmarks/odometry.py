"""Odometry against KISS-ICP and small_gicp: accuracy, time, memory, honesty. `make bench` runs all of it.

    python -m benchmarks.odometry                                            everything
    python -m benchmarks.odometry --sequences town_32 --systems scanloom     one sequence, ours only: some seconds
    python -m benchmarks.odometry --quick                                    town and real scans, without the extras
    python -m benchmarks.odometry --data FOLDER --json -                     one more log, figures as JSON
    python -m benchmarks.odometry --set voxel_size_m=0.5                     ours with another setting

What a system says of a sequence is kept (build/bench/results) until its version (of ours: its code) or the sequence
changes, so a change of ours is measured in seconds. `--fresh` runs all of them again, so that times are of one run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks import display, page, pairs, systems, tunnel, walls
from benchmarks.comparison import OURS, PEERS, SYSTEMS, Result, Runner, best, ratios
from benchmarks.scores import Figure, Score
from benchmarks.sequences import Recording, drives, make

WORK = Path("build/bench")
REAL_SCANS = Path("../shared/data/kitti_raw_0005")
HANDHELD = Path("../shared/data/deskew_newer_06")
QUICK = ("town_32", "kitti_raw_0005")
PREFIX = "bench.odometry"
PAIRS = 2000

console = Console(stderr=True, width=240)


def main(words: Sequence[str] | None = None) -> None:
    """Everything the command line asks for."""
    options = _options(words)
    started = time.monotonic()
    _greet(options.systems)
    recordings = _recordings(options)
    runner = Runner(WORK / "results", options.fresh, options.set)
    results = [
        list(runner.results(s, r)) for r in _told(recordings) for s in options.systems if systems.version(s)
    ]
    chosen = {(found[0].recording.name, found[0].system): best(found) for found in results}
    figures = [*_figures(chosen), *_variants(results), *_ratios(chosen)]
    if not options.quick and OURS in options.systems:
        figures += _extras(runner, recordings, chosen, options)
    _show(options, figures, chosen, time.monotonic() - started)


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, action="append", default=[], help="a log to compare on as well")
    parser.add_argument("--sequences", nargs="+", default=[], help="only these")
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, choices=SYSTEMS, help="only these")
    parser.add_argument(
        "--quick", action="store_true", help=f"only {', '.join(QUICK)}; no pairs, no tunnel, no walls"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of our odometry"
    )
    parser.add_argument("--json", default="", help="file for the figures, - for standard output")
    parser.add_argument("--out", type=Path, default=WORK, help="folder for the picture and the figures")
    parser.add_argument("--page", type=Path, help="a page of the documentation to write the figures into")
    parser.add_argument("--fresh", action="store_true", help="run every system again")
    options = parser.parse_args(words)
    options.set = {
        name: json.loads(value) for name, _, value in (word.partition("=") for word in options.set)
    }
    return options


def _greet(wanted: Sequence[str]) -> None:
    missing = dict.fromkeys(systems.program(system) for system in wanted if not systems.version(system))
    if missing:
        console.print(
            f"[yellow]{' and '.join(missing)} not installed: run `make bench-setup`; going on without.[/]"
        )


def _recordings(options: argparse.Namespace) -> list[Recording]:
    folders = list(options.data)
    if REAL_SCANS.exists() and all(folder.resolve() != REAL_SCANS.resolve() for folder in folders):
        folders.append(REAL_SCANS)
    wanted = options.sequences or (QUICK if options.quick else ())
    chosen = drives(folders, [name for name in wanted if name != QUICK[1] or REAL_SCANS.exists()])
    with console.status("making the sequences"):
        return make(chosen, WORK / "store")


def _told(recordings: Sequence[Recording]) -> Iterator[Recording]:
    for recording in recordings:
        with console.status(f"systems on {recording.name}"):
            yield recording


def _figures(chosen: Mapping[tuple[str, str], Result]) -> Iterator[Figure]:
    for (sequence, system), result in chosen.items():
        for score in result.scores:
            variant = f"; {result.variant}" if result.variant else ""
            yield _figure(f"{sequence}.{system}.{score.name}", score, sequence, variant)


def _variants(results: Sequence[Sequence[Result]]) -> Iterator[Figure]:
    """Of every variant the figures that choose among them."""
    for found in results:
        for result in found if len(found) > 1 else ():
            for score in result.scores:
                if score.name in ("rpe10_m", "ms_per_frame", "lost_scans"):
                    place = f"{result.recording.name}.{result.system}.{result.variant}.{score.name}"
                    yield _figure(place, score, result.recording.name)


def _ratios(chosen: Mapping[tuple[str, str], Result]) -> Iterator[Figure]:
    for score in ratios(chosen):
        yield _figure(score.name, score, "all")


def _extras(
    runner: Runner,
    recordings: Sequence[Recording],
    chosen: Mapping[tuple[str, str], Result],
    options: argparse.Namespace,
) -> Iterator[Figure]:
    by_name = {recording.name: recording for recording in recordings}
    if "tunnel" in by_name:
        with console.status("tunnel without degeneracy handling"):
            for score in tunnel.scores(runner, by_name, chosen):
                yield _figure(f"tunnel.{score.name}", score, "tunnel")
    if not options.sequences:
        with console.status("matching and other pairs"):
            for score in pairs.scores(pairs.judge_all(runner, recordings, PAIRS)):
                yield _figure(f"pairs.{score.name}", score, "pairs")
    for score in walls.scores(HANDHELD if HANDHELD.exists() else None):
        yield Figure(f"bench.deskew.{score.name}", score.value, score.unit, "walls", score.method)


def _figure(name: str, score: Score, scope: str, more: str = "") -> Figure:
    return Figure(f"{PREFIX}.{name}", score.value, score.unit, scope, score.method + more)


def _show(
    options: argparse.Namespace,
    figures: list[Figure],
    chosen: Mapping[tuple[str, str], Result],
    seconds: float,
) -> None:
    figures.append(Figure("bench.run.wall_s", seconds, "s", "run", "wall time of this benchmark"))
    rows = [figure.row() for figure in figures if np.isfinite(figure.value)]
    text = json.dumps(rows, indent=1)
    options.out.mkdir(parents=True, exist_ok=True)
    display.picture(chosen, options.out / "odometry.png")
    if options.json == "-":
        print(text)
    else:
        Path(options.json or options.out / "odometry.json").write_text(text + "\n")
    if options.page:
        page.fill(options.page, rows, _remark(seconds))
    screen = console if options.json == "-" else Console(width=240)
    screen.print(display.comparison(chosen))
    screen.print(display.summary(figures))
    screen.print(f"picture: {options.out / 'odometry.png'}; {seconds:.0f} s")


def _remark(seconds: float) -> str:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()
    programs = dict.fromkeys(systems.program(peer) for peer in PEERS)
    peers = ", ".join(f"{program} {systems.version(program) or 'not there'}" for program in programs)
    cores = len(os.sched_getaffinity(0))
    return f"Measured at commit {commit or 'unknown'}, {cores} cores, {peers}; the whole run took {seconds / 60:.1f} minutes."


if __name__ == "__main__":
    main()
