"""Systems on recordings: run them apart from each other, score them, compare."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import reference, scores, systems
from benchmarks.scores import Score
from benchmarks.sequences import MEASURED, NODE_OF, Recording
from benchmarks.systems import Outcome
from scanloom.pipeline.fingerprint import code_version, digest
from scanloom.schemas.trajectory import Truth

OURS = "scanloom"
PEERS = {
    "kiss_icp": "its better variant",
    "small_gicp": "from the same raw scans, its better voxel size",
    "vgicp_on_our_scans": "VGICP on scans compensated by our deskew, its better voxel size: registration alone",
}
"""Whom we compare with, and what of them."""
SYSTEMS = (OURS, *PEERS)
Options = dict[str, Any]
VARIANTS: Mapping[str, Mapping[str, Options]] = {
    OURS: {"": {}},
    "kiss_icp": {"deskew": {"deskew": True}},
    "small_gicp": {f"{voxel:g}m": {"voxel_m": voxel, "scans": "own"} for voxel in (0.5, 1.0)},
    "vgicp_on_our_scans": {f"{voxel:g}m": {"voxel_m": voxel, "scans": "ours"} for voxel in (0.5, 1.0)},
}
"""Of a system with variants the one with the smaller error over 10 m stands for it, sequence by sequence."""
REAL_VARIANTS: Mapping[str, Mapping[str, Options]] = {"kiss_icp": {"raw": {"deskew": False}}}
"""Tried on logs of real sensors as well."""
RATIO = "rpe10_m"


@dataclass(frozen=True)
class Result:
    """One variant of one system on one recording."""

    recording: Recording
    system: str
    variant: str
    outcome: Outcome
    scores: Sequence[Score]

    def value(self, name: str) -> float:
        """One of its scores; NaN without it."""
        return next((score.value for score in self.scores if score.name == name), float("nan"))


@dataclass(frozen=True)
class Runner:
    """Runs systems in processes of their own and keeps what peers said."""

    folder: Path
    fresh: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of our odometry that are not the default."""

    def truth(self, recording: Recording) -> tuple[Truth, Truth | None]:
        """Truth for errors over short stretches, and the log's own where it is too coarse for that."""
        own = recording.one(Truth)
        if len(own) and not own.source.startswith("OXTS"):
            return own, None
        rough = self.outcome("small_gicp", recording, VARIANTS["small_gicp"]["1m"])
        return reference.kept(recording, rough.T, self.folder), own if len(own) else None

    def outcome(self, system: str, recording: Recording, options: Options) -> Outcome:
        """What a system says; its earlier word is taken when the system and its input are the same."""
        if system == OURS:
            options = {**options, "settings": {**self.settings, **options.get("settings", {})}}
        program = systems.program(system)
        words = re.sub(r"[^\w.=,-]+", "", "-".join(f"{k}={v}" for k, v in sorted(options.items())))
        name = "_".join(
            (recording.name, program, systems.version(system), words, _digest(system, recording, options))
        )
        kept = self.folder / f"{name}.npz"
        if kept.exists() and not self.fresh:
            return Outcome.read(kept)
        self.folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            outcome = _run(program, recording, options, Path(folder))
            (Path(folder) / "out.npz").replace(kept)
        return outcome

    def results(self, system: str, recording: Recording) -> list[Result]:
        """All variants of a system on a recording."""
        truth, coarse = self.truth(recording)
        variants = dict(VARIANTS[system])
        if not recording.simulated:
            variants |= REAL_VARIANTS.get(system, {})
        found = []
        for variant, options in variants.items():
            outcome = self.outcome(system, recording, options)
            said = list(scores.accuracy(truth, outcome, len(recording)))
            if coarse is not None:
                said = list(scores.with_coarse_truth(said, coarse, outcome, len(recording)))
            said += scores.cost(outcome)
            if system == OURS:
                said += self._ours(recording, outcome, truth if recording.simulated else None)
            found.append(Result(recording, system, variant, outcome, said))
        return found

    def _ours(self, recording: Recording, outcome: Outcome, truth: Truth | None) -> Iterator[Score]:
        """What only our odometry tells; a second run, from files and with all cores, gives memory and repeatability."""
        again = self.outcome(OURS, recording, {"timed": False})
        yield from scores.peak(again)
        yield Score(
            "repeatable",
            float(np.array_equal(again.T, outcome.T)),
            "",
            "1 when one core and all give the same",
        )
        whole = float(again.extra["whole_ms"]) / len(again.T)
        yield Score("ms_per_frame_pipeline", whole, "ms", "mean, reading included, all cores")
        yield from scores.deskewing(outcome)
        yield from scores.sensors(outcome)
        yield from scores.candour(truth, outcome)


def _digest(system: str, recording: Recording, options: Options) -> str:
    """Of what a system reads; of our own also of its code."""
    if system != OURS:
        return recording.deskewed_digest if options.get("scans") == "ours" else recording.digest
    code = [code_version(NODE_OF[stage].stage, 0) for stage in MEASURED]
    return digest([code, recording.made_digest])[:16]


def _run(program: str, recording: Recording, options: Options, folder: Path) -> Outcome:
    """In a process of its own, with all threads it wants."""
    order, out = folder / "order.json", folder / "out.npz"
    body = {
        "program": program,
        "options": options,
        "out": str(out),
        "recording": dataclasses.asdict(recording),
    }
    order.write_text(json.dumps(body))
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    words = [sys.executable, "-m", "benchmarks.systems", str(order)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{program} failed on {recording.name}:\n{done.stderr[-2000:]}")
    return Outcome.read(out)


def best(results: Sequence[Result]) -> Result:
    """The variant with the smallest error over 10 m; one that lost track comes last."""
    return min(results, key=lambda result: np.nan_to_num(result.value(RATIO), nan=np.inf))


def ratios(chosen: Mapping[tuple[str, str], Result]) -> Iterator[Score]:
    """Ours over each peer. `chosen`: by (sequence, system), the best variant."""
    sequences = list(dict.fromkeys(sequence for sequence, _ in chosen))
    for peer, which in PEERS.items():
        yield from _error_ratios(peer, which, chosen, sequences)
    yield from _time_ratios(chosen, sequences)


def _error_ratios(
    peer: str, which: str, chosen: Mapping[tuple[str, str], Result], sequences: Sequence[str]
) -> Iterator[Score]:
    found = {}
    how = f"ours over {peer}, error over 10 m, {which}"
    for sequence in sequences:
        own, other = chosen.get((sequence, OURS)), chosen.get((sequence, peer))
        if own and other and np.isfinite(own.value(RATIO) / other.value(RATIO)):
            found[sequence] = (own.value(RATIO) / other.value(RATIO), own.recording.simulated)
            yield Score(f"ratio.{peer}.{sequence}", found[sequence][0], "", how)
    if not found:
        return
    values = [value for value, _ in found.values()]
    simulated = [value for value, made in found.values() if made]
    yield Score(f"ratio.{peer}", float(np.mean(values)), "", f"mean over {_count(values)}: {how}")
    yield Score(f"ratio.{peer}.worst", float(max(values)), "", f"largest: {how}")
    if simulated:
        mean = float(np.mean(simulated))
        yield Score(f"ratio.{peer}.simulated", mean, "", f"simulated sequences only: {how}")


def _time_ratios(chosen: Mapping[tuple[str, str], Result], sequences: Sequence[str]) -> Iterator[Score]:
    odometry, both = [], []
    for sequence in sequences:
        own, kiss = chosen.get((sequence, OURS)), chosen.get((sequence, "kiss_icp"))
        if own and kiss:
            theirs = kiss.value("ms_per_frame_mean")
            odometry.append(own.value("ms_per_frame_mean") / theirs)
            both.append((own.value("ms_per_frame_mean") + own.value("deskew_ms_per_frame_mean")) / theirs)
    if not odometry:
        return
    for name, values in (("time_ratio.odometry", odometry), ("time_ratio.with_deskew", both)):
        how = "ours on one core over KISS-ICP with all its threads, mean time per frame"
        yield Score(name, float(np.mean(values)), "", f"mean over {_count(values)}: {how}")
        yield Score(f"{name}.worst", float(max(values)), "", f"largest: {how}")


def _count(values: Sequence[float]) -> str:
    return f"{len(values)} sequence{'s' if len(values) > 1 else ''}"
