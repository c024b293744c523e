"""Loops: places known again by their looks, scan context against STV-SC; what verification makes of them.

    python -m benchmarks.loops                                  everything: some ten minutes when nothing is made yet
    python -m benchmarks.loops --worlds estates --seeds 0       one simulated world
    python -m benchmarks.loops --data FOLDER --json -           one more log that has truth, figures as JSON
    python -m benchmarks.loops --worlds --data FOLDER           this log alone

Simulated drives and what the stages make of them are kept (build/bench/store) until settings or code change.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import loop_levels, places_cost, places_loops, places_search
from benchmarks.figures import written
from benchmarks.places_worlds import KINDS, SEEDS, World, given, simulated, world
from benchmarks.scores import Figure
from scanloom.schemas.errors import ScanloomError

WORK = Path("build/bench")
console = Console(stderr=True, width=200)


def main(words: Sequence[str] | None = None) -> None:
    """Everything the command line asks for."""
    options = _options(words)
    started = time.monotonic()
    figures: list[Figure] = []
    everything: list[World] = []
    for kind in options.worlds:
        with console.status(f"{kind}"):
            worlds = [world(drive, options.store) for drive in simulated(kind, options.seeds)]
        figures += _of(kind, worlds)
        everything += worlds
    for folder in options.data:
        figures += _of_log(folder, options.store)
    if options.levels and everything:
        with console.status("matching at levels 1 to 5"):
            figures += loop_levels.figures([(one, one) for one in everything])
    figures.append(
        Figure("bench.run.wall_s", time.monotonic() - started, "s", "run", "wall time of this benchmark")
    )
    _show(options, figures)


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, action="append", default=[], help="a log with truth, as well")
    parser.add_argument("--worlds", nargs="*", default=list(KINDS), choices=list(KINDS), help="only these")
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=list(SEEDS), help="only these worlds of a kind"
    )
    parser.add_argument(
        "--levels", action=argparse.BooleanOptionalAction, default=True, help="matching at levels 1 to 5"
    )
    parser.add_argument("--store", type=Path, default=WORK / "store", help="where drives are kept")
    parser.add_argument("--json", default="", help="file for the figures, - for standard output")
    parser.add_argument("--out", type=Path, default=WORK, help="folder for the figures")
    return parser.parse_args(words)


def _of(kind: str, worlds: Sequence[World]) -> Iterator[Figure]:
    yield from places_search.figures(kind, worlds)
    yield from places_loops.figures(kind, worlds)
    yield from places_cost.figures(worlds[0])


def _of_log(folder: Path, store: Path) -> Iterator[Figure]:
    """The same of a log; a plain sentence where it lacks what it takes."""
    try:
        found = world(given(folder), store)
    except (ScanloomError, SystemExit) as error:
        console.print(f"[yellow]{folder}: {error}; going on without.[/]")
        return
    yield from _of(found.name, [found])


def _show(options: argparse.Namespace, figures: Sequence[Figure]) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    written(figures, options.json or options.out / "loops.json")
    table = Table("figure", "value", "how")
    for figure in figures:
        if "within_" not in figure.name:
            table.add_row(figure.name, f"{figure.value:.3f} {figure.unit}", figure.method)
    console.print(table)


if __name__ == "__main__":
    main()
