"""Fusion against what others do with the same graphs: loops of which many are false, optimal costs, GNSS that lies.

    python -m benchmarks.fusion                          everything, a table on the screen
    python -m benchmarks.fusion --data FOLDER --json -   figures as JSON
    python -m benchmarks.fusion --only bicocca           one part of it

What is missing under FOLDER is left out and said so.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import bicocca, city, costs, outage
from benchmarks.scores import Figure

STORE = Path("build/bench/store")
console = Console(stderr=True, width=160)


def main(words: Sequence[str] | None = None) -> None:
    """Everything the command line asks for."""
    options = _options(words)
    figures: list[Figure] = []
    for name, part in PARTS.items():
        if not options.only or name in options.only:
            started = time.monotonic()
            with console.status(name):
                figures += part(options.data)
            console.print(f"{name}: {time.monotonic() - started:.0f} s")
    text = json.dumps([figure.row() for figure in figures], indent=1)
    if options.json == "-":
        print(text)
    elif options.json:
        Path(options.json).write_text(text + "\n")
    console.print(_table(figures))


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the real data")
    parser.add_argument("--only", nargs="+", default=[], choices=tuple(PARTS), help="only these parts")
    parser.add_argument("--json", default="", help="file for the figures, - for standard output")
    return parser.parse_args(words)


def _bicocca(data: Path) -> Iterator[Figure]:
    yield from _if_there(data / "pose_graphs" / bicocca.FILE, bicocca.figures)


def _costs(data: Path) -> Iterator[Figure]:
    for name in costs.OPTIMA:
        yield from _if_there(data / "pose_graphs" / f"{name}.g2o", costs.figures)


def _kitti(data: Path) -> Iterator[Figure]:
    if importlib.util.find_spec("benchmarks.kitti_gnss") is None:
        console.print("kitti_gnss: this part is not there yet")
        return
    module = importlib.import_module("benchmarks.kitti_gnss")
    if not hasattr(module, "figures"):
        console.print("kitti_gnss: this part is not finished yet")
        return
    yield from _if_there(data / "kitti_00_trajectory", lambda folder: module.figures(folder.parent))


def _city(_: Path) -> Iterator[Figure]:
    yield from city.figures()


def _outage(_: Path) -> Iterator[Figure]:
    yield from outage.figures(STORE)


def _if_there(path: Path, figures: Callable[[Path], Iterator[Figure]]) -> Iterator[Figure]:
    if path.exists():
        yield from figures(path)
    else:
        console.print(f"left out: {path} does not exist")


PARTS: dict[str, Callable[[Path], Iterator[Figure]]] = {
    "bicocca": _bicocca,
    "costs": _costs,
    "kitti": _kitti,
    "city": _city,
    "outage": _outage,
}


def _table(figures: Sequence[Figure]) -> Table:
    table = Table("figure", "value", "unit", "how")
    for f in figures:
        table.add_row(f.name, f"{f.value:.6g}", f.unit, f.method)
    return table


if __name__ == "__main__":
    main()
