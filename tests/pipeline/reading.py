"""What tests look at: the bytes of a store, and verdicts of a run or plan."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path

from scanloom.pipeline.plan import PlannedTask
from scanloom.pipeline.run import Result, TaskRecord
from scanloom.pipeline.store import Store


def contents(store: Store) -> dict[str, str]:
    """Digest of every file of every artifact but `run.json`, which tells what varies between runs."""
    return {
        path.relative_to(store.root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for stage in store.stages()
        for path in sorted((store.root / stage).rglob("*"))
        if path.is_file() and path.name != "run.json"
    }


def verdicts(lines: Result | list[PlannedTask]) -> dict[str, Counter[str]]:
    """{node: {verdict: count}}."""
    found: dict[str, Counter[str]] = {}
    for line in lines.tasks if isinstance(lines, Result) else lines:
        found.setdefault(line.node, Counter())[line.verdict] += 1
    return found


def record(result: Result, node: str, **coordinate: str) -> TaskRecord:
    return next(t for t in result.tasks if t.node == node and t.coordinate == coordinate)


def leftovers(store: Store) -> list[Path]:
    return list((store.root / "tmp").iterdir())
