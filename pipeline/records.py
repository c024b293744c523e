"""What the store remembers of runs and failures; it is not part of any key."""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import psutil

from scanloom.pipeline.store import FAILURES, RUNS, Store, store_error
from scanloom.schemas.errors import ScanloomError

RUNNING = "running"


class RunRecord:
    """`runs/<number>.json`: when, where, and the keys that a run used."""

    def __init__(self, path: Path, body: dict[str, Any]) -> None:
        self.path = path
        self.body = body

    @classmethod
    def start(cls, store: Store) -> Self:
        """Take the next number; a run that never ends stays `running` until its process is gone."""
        body = {
            "state": RUNNING,
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "started_unix_s": time.time(),
            "tasks": [],
        }
        number = max([int(path.stem) for path in (store.root / RUNS).glob("[0-9]*.json")], default=0)
        while True:
            number += 1
            record = cls(store.root / RUNS / f"{number:06d}.json", body)
            try:
                record.path.touch(exist_ok=False)
            except FileExistsError:
                continue
            except OSError as error:
                raise store_error(error, record.path) from error
            record.write()
            return record

    def finish(self, state: str, tasks: Iterable[tuple[str, Mapping[str, str], str, str]]) -> None:
        """Best effort: a full disk must not hide the error that ended the run."""
        self.body["state"] = state
        self.body["ended_unix_s"] = time.time()
        self.body["tasks"] = [
            {"stage": stage, "coordinate": dict(place), "key": key, "verdict": verdict}
            for stage, place, key, verdict in tasks
        ]
        try:
            self.write()
        except OSError:
            return

    def write(self) -> None:
        fresh = self.path.with_suffix(f".{os.getpid()}.new")
        fresh.write_text(json.dumps(self.body, indent=1, sort_keys=True) + "\n")
        os.replace(fresh, self.path)

    @property
    def alive(self) -> bool:
        """Is the run still going? On another machine: assumed so for a day."""
        if self.body.get("state") != RUNNING:
            return False
        if self.body.get("host") != socket.gethostname():
            return time.time() - float(self.body.get("started_unix_s", 0)) < 86400
        return psutil.pid_exists(int(self.body["pid"]))

    @property
    def keys(self) -> set[tuple[str, str]]:
        return {(task["stage"], task["key"]) for task in self.body.get("tasks", []) if task["key"]}


def run_records(store: Store) -> list[RunRecord]:
    """All runs, oldest first; unreadable records are left out."""
    records = []
    for path in sorted((store.root / RUNS).glob("[0-9]*.json"), key=lambda p: int(p.stem)):
        try:
            records.append(RunRecord(path, json.loads(path.read_bytes())))
        except (OSError, ValueError):
            continue
    return records


def record_failure(store: Store, place: str, error: ScanloomError, trace: str) -> Path | None:
    """Keep the error and the traceback of a failed task in `failures/`, until the task succeeds."""
    path = _failure_path(store, place)
    try:
        path.write_text(f"{error}\n\n{trace}")
    except OSError:
        return None
    return path


def forget_failure(store: Store, place: str) -> None:
    """The task succeeded."""
    with suppress(OSError):
        _failure_path(store, place).unlink(missing_ok=True)


def _failure_path(store: Store, place: str) -> Path:
    return store.root / FAILURES / (re.sub(r"[^A-Za-z0-9._-]+", "-", place) + ".txt")
