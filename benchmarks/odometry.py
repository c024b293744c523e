"""Odometry against KISS-ICP and small_gicp: accuracy, time, memory, honesty. `make bench` runs all of it.

    python -m benchmarks.odometry                                            everything
    python -m benchmarks.odometry --sequences town_32 --systems scanloom     one sequence, ours only: some seconds
    python -m benchmarks.odometry --data FOLDER --json -                     one more log, figures as JSON

What the peers say of a sequence is kept (build/bench/results) until the peer's version or the sequence changes, so a
change of ours is measured against it in seconds; `--fresh` runs them again, which times need to be comparable.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks import scores, systems
from benchmarks.scores import Figure, Score
from benchmarks.sequences import Recording, drives, make
from benchmarks.systems import Outcome
from scanloom.schemas.trajectory import Truth

WORK = Path("build/bench")
KITTI_FOLDER = Path("../shared/data/kitti_raw_0005")
WIDTH = 180
PEERS = ("kiss_icp", "small_gicp")
SYSTEMS = ("scanloom", *PEERS)
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "scanloom": {"": {}},
    "kiss_icp": {"deskew": {"deskew": True}},
    "small_gicp": {
        f"{scans}_{voxel:g}m": {"voxel_m": voxel, "scans": scans}
        for scans in ("own", "ours")
        for voxel in (0.5, 1.0)
    },
}
"""Of a system with variants the one with the smaller error over 10 m stands for it, sequence by sequence."""

console = Console(stderr=True, width=180)


def main(words: Sequence[str] | None = None) -> None:
    options = _options(words)
    folders = [*options.data]
    if KITTI_FOLDER.exists() and not any(f.resolve() == KITTI_FOLDER.resolve() for f in folders):
        folders.append(KITTI_FOLDER)
    recordings = make(drives(folders, options.sequences), WORK / "store")
    figures: list[Figure] = []
    table = _table()
    for recording in recordings:
        for system in options.systems:
            if not systems.version(system):
                continue
            name, outcome, said = best(system, recording, options.fresh)
            place = f"bench.odometry.{recording.name}.{system}"
            figures += [Figure(f"{place}.{s.name}", s.value, s.unit, recording.name, s.method) for s in said]
            _add_row(table, recording, system, name, said)
    (console if options.json == "-" else Console(width=WIDTH)).print(table)
    _write_json(figures, options.json)


def _options(words: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, action="append", default=[], help="a log to compare on as well")
    parser.add_argument("--sequences", nargs="+", default=[], help="only these")
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, choices=SYSTEMS, help="only these")
    parser.add_argument("--json", default="", help="file for the figures, - for standard output")
    parser.add_argument("--fresh", action="store_true", help="run the peers again")
    return parser.parse_args(words)


def best(system: str, recording: Recording, fresh: bool) -> tuple[str, Outcome, list[Score]]:
    """The variant with the smallest error over 10 m: its name, what it said, its scores."""
    truth = recording.one(Truth)
    tried = []
    variants = VARIANTS[system]
    if system == "kiss_icp" and not recording.simulated:
        variants = {**variants, "raw": {"deskew": False}}
    for name, options in variants.items():
        outcome = outcome_of(system, recording, options, fresh)
        said = [*scores.accuracy(truth, outcome, len(recording)), *scores.cost(outcome)]
        if system == "scanloom":
            said += ours(truth, recording, outcome)
        tried.append((name, outcome, said))
    return min(tried, key=lambda one: next((s.value for s in one[2] if s.name == "rpe10_m"), np.inf))


def ours(truth: Truth, recording: Recording, outcome: Outcome) -> list[Score]:
    """What only our odometry tells."""
    deskew_ms = outcome.extra["deskew_ms"]
    said = [
        Score("deskew_ms_per_frame", float(np.median(deskew_ms)), "ms", "median, compute only, one thread"),
        Score("unreliable_scans", int((~outcome.extra["reliable"]).sum()), "", "scans bridged by prediction"),
    ]
    if recording.simulated:
        squares = scores.nees(truth, outcome)
        said.append(
            Score("nees", float(squares.mean()), "", "mean over the motions between consecutive scans")
        )
        said.append(
            Score("nees_median", float(np.median(squares)), "", "median of the same; 5.35 is expected")
        )
    return said


def outcome_of(system: str, recording: Recording, options: dict[str, Any], fresh: bool) -> Outcome:
    """Run a system in a process of its own; a peer's earlier outcome is taken when there is one."""
    words = "-".join(f"{k}={v}" for k, v in sorted(options.items()))
    name = "_".join(filter(None, (recording.name, system, systems.version(system), words, recording.digest)))
    kept = WORK / "results" / f"{name}.npz"
    if system in PEERS and options.get("scans") != "ours" and kept.exists() and not fresh:
        return Outcome.read(kept)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, console.status(f"{recording.name}: {system} {words}"):
        order = {
            "system": system, "options": options, "out": str(kept), "recording": dataclasses.asdict(recording),
        }  # fmt: skip
        path = Path(folder) / "order.json"
        path.write_text(json.dumps(order))
        environment = {**os.environ}
        for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            environment.pop(threads, None)
        subprocess.run([sys.executable, "-m", "benchmarks.systems", str(path)], check=True, env=environment)
    return Outcome.read(kept)


COLUMNS = ("rpe1_m", "rpe5_m", "rpe10_m", "rpe20_m", "kitti_t_rel_percent", "ate_m", "nees", "ms_per_frame",
           "ms_per_frame_p95", "deskew_ms_per_frame", "peak_rss_mb", "unreliable_scans", "lost_scans")  # fmt: skip


def _table() -> Table:
    table = Table(title="odometry")
    for column in ("sequence", "system", *COLUMNS):
        table.add_column(column.replace("_per_frame", "").replace("_", " "), justify="left")
    return table


def _add_row(table: Table, recording: Recording, system: str, name: str, said: Sequence[Score]) -> None:
    values = {score.name: score.value for score in said}
    cells = [f"{values[c]:.4g}" if c in values else "" for c in COLUMNS]
    table.add_row(recording.name, f"{system} {name}".strip(), *cells)


def _write_json(figures: Sequence[Figure], target: str) -> None:
    text = json.dumps([figure.row() for figure in figures], indent=1)
    if target == "-":
        print(text)
    elif target:
        Path(target).write_text(text + "\n")


if __name__ == "__main__":
    main()
