"""Garbage and status of a store."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import StoreError
from tests.pipeline.reading import contents, leftovers
from tests.pipeline.toys.workflow import log, request

A = range(30)


def runs(tmp_path: Path, store: Store, *widths: int) -> list[dict[str, str]]:
    """Runs with several tile widths; the bytes of the store after each."""
    after = []
    for width in widths:
        run(request(log(tmp_path, "a", A), settings={"cut": {"width": width}}), store, cluster="none")
        after.append(contents(store))
    return after


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_gc_keeps_what_the_last_runs_used(tmp_path, store):
    one, both = runs(tmp_path, store, 10, 7)
    assert store.gc(keep_runs=2).artifacts == []

    planned = store.gc(keep_runs=1, dry_run=True)
    assert {a.stage for a in planned.artifacts} == {"cut", "paint", "survey"}
    assert planned.bytes > 0
    assert contents(store) == both

    done = store.gc(keep_runs=1)
    assert [a.key for a in done.artifacts] == [a.key for a in planned.artifacts]
    assert len(contents(store)) < len(both)
    asked = request(log(tmp_path, "a", A), settings={"cut": {"width": 7}})
    assert run(asked, store, cluster="none").executed == 0
    assert run(request(log(tmp_path, "a", A)), store, cluster="none").executed == 7
    assert contents(store) == both
    assert set(one) < set(both)


def test_gc_keeps_named_keys_and_young_artifacts(tmp_path, store):
    runs(tmp_path, store, 10, 7)
    old = store.gc(keep_runs=1, dry_run=True).artifacts
    assert store.gc(keep_runs=1, keep={a.key for a in old}, dry_run=True).artifacts == []
    assert store.gc(keep_runs=1, older_than_s=3600, dry_run=True).artifacts == []


def test_gc_keeps_what_a_killed_run_has_done_so_far(tmp_path, store):
    runs(tmp_path, store, 10)
    record = next((store.root / "runs").glob("*.json"))
    body = json.loads(record.read_text())
    record.write_text(json.dumps({**body, "state": "running", "tasks": [], "pid": dead_pid()}))
    assert store.gc(keep_runs=1).artifacts == []
    assert store.status().runs[0].state == "killed"


def test_gc_waits_for_a_run_in_progress(tmp_path, store):
    runs(tmp_path, store, 10)
    record = next((store.root / "runs").glob("*.json"))
    body = json.loads(record.read_text())
    record.write_text(json.dumps({**body, "state": "running", "pid": os.getppid()}))
    with pytest.raises(StoreError, match="run 000001 is in progress"):
        store.gc()


def test_leftovers_of_dead_processes_go_and_others_stay(tmp_path, store):
    here = socket.gethostname()
    for name in (f"a.{dead_pid()}.{here}", f"b.{os.getpid()}.{here}", "c.1.elsewhere", "strange"):
        (store.root / "tmp" / name).mkdir()
        (store.root / "tmp" / name / "half.parquet").touch()
    runs(tmp_path, store, 10)
    assert sorted(p.name.partition(".")[0] for p in leftovers(store)) == ["b", "c"]


def test_status(tmp_path, store):
    runs(tmp_path, store, 10)
    run(request(log(tmp_path, "bad", A, "broken")), store, cluster="none")
    found = store.status()
    assert {s.stage: s.artifacts for s in found.stages} == {
        "read": 1, "smooth": 3, "track": 1, "join": 1, "cut": 3, "paint": 3, "survey": 1
    }  # fmt: skip
    assert found.bytes == sum(a.size for a in store.artifacts()) > 1000
    assert [r.state for r in found.runs] == ["finished", "finished"]
    assert found.runs[0].verdicts == {"FAILED": 1, "SKIPPED": 3}
    assert found.runs[1].verdicts == {"RUN": 13}
    assert [task for task, _ in found.failures] == ["read-session-bad"]


def test_first_writer_wins(store):
    """Two processes made the same artifact: the first one stands, the second is content with it."""
    from tests.pipeline.toys.products import Info

    identity = {"stage": "read"}
    with store.draft("read", "k") as first, store.draft("read", "k") as second:
        first.write(Info(count=1, title="first"), None)
        second.write(Info(count=2, title="second"), None)
        first.publish(identity, {})
        artifact = second.publish(identity, {})
    assert Info.open(artifact.path(artifact.parts[0])).title == "first"
    assert leftovers(store) == []


@pytest.mark.parametrize("key", ["../x", ".hidden", "a/b", ""])
def test_part_keys_stay_inside_the_artifact(store, key):
    import numpy as np

    from scanloom.schemas.errors import ProductError
    from tests.pipeline.toys.products import Shift

    with store.draft("join", "k") as draft, pytest.raises(ProductError, match="part key"):
        draft.write(Shift(value=np.array([1])), key)
