"""What a store holds, and why an artifact is what it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanloom.pipeline.history import differences
from scanloom.pipeline.records import RunRecord, run_records
from scanloom.pipeline.store import FAILURES, QUARANTINE, Artifact, Store
from scanloom.pipeline.upkeep import leftovers, listed
from scanloom.schemas.errors import UsageError


@dataclass(frozen=True)
class StageStatus:
    stage: str
    artifacts: int
    bytes: int


@dataclass(frozen=True)
class RunStatus:
    number: int
    state: str
    """`finished`, `failed`, `interrupted`, `running` or `killed`."""
    started_unix_s: float
    wall_s: float
    verdicts: dict[str, int]


@dataclass(frozen=True)
class Status:
    """What a store holds."""

    root: Path
    stages: list[StageStatus]
    runs: list[RunStatus]
    """The last ones, newest first."""
    failures: list[tuple[str, str]]
    """(task, error) of tasks that failed and were not made good since."""
    leftovers: int
    quarantined: int

    @property
    def bytes(self) -> int:
        return sum(stage.bytes for stage in self.stages)


def status(store: Store, *, last_runs: int = 5) -> Status:
    """Size per stage, last runs, standing failures."""
    stages = []
    for name in store.stages():
        artifacts = list(store.artifacts(name))
        stages.append(StageStatus(name, len(artifacts), sum(artifact.size for artifact in artifacts)))
    runs = [_run_status(run) for run in run_records(store)[-last_runs:]]
    failures = [(path.stem, _first_line(path)) for path in listed(store.root / FAILURES)]
    quarantined = len(listed(store.root / QUARANTINE))
    return Status(store.root, stages, runs[::-1], failures, len(leftovers(store)), quarantined)


def _run_status(run: RunRecord) -> RunStatus:
    verdicts: dict[str, int] = {}
    for task in run.body.get("tasks", []):
        verdicts[task["verdict"]] = verdicts.get(task["verdict"], 0) + 1
    state = str(run.body.get("state"))
    if state == "running" and not run.alive:
        state = "killed"
    started = float(run.body.get("started_unix_s", 0.0))
    return RunStatus(
        int(run.path.stem), state, started, float(run.body.get("ended_unix_s", started)) - started, verdicts
    )


@dataclass(frozen=True)
class InputReason:
    """One product that an artifact was made of."""

    product: str
    parts: int
    made_by: list[str]
    """`stage/key` of the artifacts in this store with these bytes; empty for files from outside."""


@dataclass(frozen=True)
class Explanation:
    """Why an artifact is what it is."""

    artifact: Artifact
    coordinate: dict[str, str]
    settings: dict[str, Any]
    code: dict[str, Any]
    inputs: list[InputReason]
    before: str
    """Key of the latest earlier artifact of this stage at the same coordinate; empty when there is none."""
    changes: list[str]
    """What differs from that one."""


def explain(store: Store, key_or_prefix: str) -> Explanation:
    """Settings, code and inputs of one artifact, and what changed since the one before it.

    `key_or_prefix` is the start of a key, or `stage/` and the start of a key.

    Raises
    ------
    UsageError : no artifact has such a key, or several have.
    """
    artifact = _one(store, key_or_prefix)
    identity = artifact.identity
    before = _before(store, artifact)
    return Explanation(
        artifact=artifact,
        coordinate=dict(artifact.run.get("coordinate", [])),
        settings=dict(identity["settings"]),
        code=dict(identity["code"]),
        inputs=_origins(store, identity["inputs"]),
        before=before.key if before else "",
        changes=differences(before.identity, identity) if before else [],
    )


def _one(store: Store, key_or_prefix: str) -> Artifact:
    stage, slash, prefix = key_or_prefix.rpartition("/")
    names = [stage] if slash else store.stages()
    found = [a for name in names for a in store.artifacts(name) if a.key.startswith(prefix)]
    if len(found) == 1:
        return found[0]
    if not found:
        raise UsageError(
            f"no artifact has a key that starts with {key_or_prefix!r}",
            where=str(store.root),
            next_step="`scanloom map LOG --dry-run` shows the keys of a map",
        )
    shown = ", ".join(f"{a.stage}/{a.key[:16]}" for a in found[:5])
    raise UsageError(f"{len(found)} artifacts have such a key: {shown}", next_step="give more of the key")


def _before(store: Store, artifact: Artifact) -> Artifact | None:
    place, made = artifact.run.get("coordinate"), artifact.run.get("finished_unix_s", 0.0)
    earlier = [
        a
        for a in store.artifacts(artifact.stage)
        if a.key != artifact.key
        and a.run.get("coordinate") == place
        and a.run.get("finished_unix_s", 0.0) <= made
    ]
    return max(earlier, key=lambda a: float(a.run.get("finished_unix_s", 0.0)), default=None)


def _origins(store: Store, inputs: list[dict[str, Any]]) -> list[InputReason]:
    makers: dict[tuple[str, str], set[str]] = {}
    for artifact in store.artifacts():
        for part in artifact.parts:
            makers.setdefault((part.product, part.digest), set()).add(f"{artifact.stage}/{artifact.key}")
    reasons = []
    for entry in inputs:
        found: set[str] = set()
        for _, content in entry["parts"]:
            found |= makers.get((entry["product"], content), set())
        reasons.append(InputReason(entry["product"], len(entry["parts"]), sorted(found)))
    return reasons


def _first_line(path: Path) -> str:
    try:
        return path.read_text(errors="replace").partition("\n")[0]
    except OSError:
        return ""
