"""Looking after a store: is it intact, and what may go."""

from __future__ import annotations

import os
import shutil
import socket
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from scanloom.pipeline.fingerprint import digest, file_digest
from scanloom.pipeline.records import RunRecord, run_records
from scanloom.pipeline.store import (
    MANIFEST,
    QUARANTINE,
    TMP,
    Artifact,
    Store,
    set_aside,
    store_error,
)
from scanloom.schemas.errors import StoreError

KEEP_RUNS = 10
"""Runs whose artifacts `gc` keeps."""

LEFTOVER_S = 86400.0
"""Age from which a half-written folder of another machine counts as abandoned."""


# --- verify ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Problem:
    """A damaged artifact. It was moved to quarantine, so that the next run makes it anew."""

    stage: str
    key: str
    path: str
    what: str
    moved_to: str


def verify(store: Store) -> list[Problem]:
    """Read every file again and compare it with its digest; damaged artifacts go to quarantine."""
    problems = []
    for stage in store.stages():
        for key in sorted(os.listdir(store.root / stage)):
            folder = store.folder(stage, key)
            found = next(_damage(folder, stage, key), None)
            if found is not None:
                path, what = found
                problems.append(Problem(stage, key, path, what, str(set_aside(store, folder))))
    return problems


def _damage(folder: Path, stage: str, key: str) -> Iterator[tuple[str, str]]:
    """(file, what is wrong with it) of one artifact."""
    try:
        artifact = Artifact.read(folder)
    except (OSError, ValueError) as error:
        yield MANIFEST, f"the manifest cannot be read: {error}"
        return
    if (artifact.stage, artifact.key) != (stage, key) or digest(artifact.identity) != key:
        yield MANIFEST, "the manifest belongs to another key"
    for part in artifact.parts:
        for file in part.files:
            path = folder / file.path
            try:
                if path.stat().st_size != file.size:
                    yield file.path, f"it has {path.stat().st_size} bytes where {file.size} were written"
                elif file_digest(path) != file.sha256:
                    yield file.path, "its bytes are not those that were written"
            except OSError as error:
                yield file.path, f"it cannot be read: {error.strerror or error}"


# --- gc -------------------------------------------------------------------------------------------------------------


@dataclass
class Garbage:
    """What was removed, or would be."""

    artifacts: list[Artifact] = field(default_factory=list)
    leftovers: list[Path] = field(default_factory=list)
    """Half-written folders of processes that are gone, and quarantined artifacts."""
    records: list[Path] = field(default_factory=list)
    bytes: int = 0


def gc(
    store: Store,
    *,
    keep: Collection[str] = (),
    keep_runs: int = KEEP_RUNS,
    older_than_s: float = 0.0,
    dry_run: bool = False,
) -> Garbage:
    """Drop what the last `keep_runs` runs did not use, what is half-written, and what is damaged.

    Artifacts whose key is in `keep`, that are younger than `older_than_s`, or that were made since the first of these
    runs began (also by a run that was killed) stay.

    Raises
    ------
    StoreError : a run is in progress, or the store cannot be written.
    """
    runs = run_records(store)
    _refuse_while_running(store, runs)
    kept = runs[-keep_runs:] if keep_runs > 0 else []
    used = {pair for run in kept for pair in run.keys}
    since = min((float(run.body["started_unix_s"]) for run in kept), default=float("inf"))
    since = min(since, time.time() - older_than_s) if older_than_s else since
    garbage = Garbage(records=[run.path for run in runs[: len(runs) - len(kept)]])
    for artifact in store.artifacts():
        made = float(artifact.run.get("finished_unix_s", 0.0))
        if (artifact.stage, artifact.key) not in used and artifact.key not in keep and made < since:
            garbage.artifacts.append(artifact)
            garbage.bytes += artifact.size
    garbage.leftovers = [*leftovers(store), *listed(store.root / QUARANTINE)]
    garbage.bytes += sum(_size(path) for path in garbage.leftovers)
    if not dry_run:
        _remove(garbage)
    return garbage


def leftovers(store: Store) -> list[Path]:
    """Half-written folders whose process is gone."""
    return [folder for folder in listed(store.root / TMP) if _abandoned(folder)]


def clean(store: Store) -> None:
    """Remove what killed runs left behind."""
    for folder in leftovers(store):
        shutil.rmtree(folder, ignore_errors=True)


def _abandoned(folder: Path) -> bool:
    """Its name ends in `.<pid>.<host>`."""
    pieces = folder.name.split(".", 2)
    try:
        pid, host = int(pieces[1]), pieces[2]
        if host == socket.gethostname():
            started = folder.stat().st_mtime
            return not psutil.pid_exists(pid) or psutil.Process(pid).create_time() > started + 1.0
        return time.time() - folder.stat().st_mtime > LEFTOVER_S
    except (IndexError, ValueError):
        return True
    except (OSError, psutil.Error):
        return False


def _refuse_while_running(store: Store, runs: list[RunRecord]) -> None:
    for run in runs:
        if run.alive and run.body.get("pid") != os.getpid():
            raise StoreError(
                f"run {run.path.stem} is in progress (process {run.body['pid']} on {run.body['host']})",
                where=str(store.root),
                next_step="wait until it has ended",
            )


def _remove(garbage: Garbage) -> None:
    try:
        for artifact in garbage.artifacts:
            # Without its manifest an artifact does not exist, whatever happens to the rest.
            (artifact.folder / MANIFEST).unlink()
            shutil.rmtree(artifact.folder)
        for path in garbage.records:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise store_error(error, Path(str(error.filename))) from error
    for path in garbage.leftovers:
        shutil.rmtree(path, ignore_errors=True)


# --- files ----------------------------------------------------------------------------------------------------------


def listed(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _size(path: Path) -> int:
    try:
        return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    except OSError:
        return 0
