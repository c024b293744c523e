"""A disk that fills up or forgets: a clear error, nothing half-written, and a flipped bit is found."""

from __future__ import annotations

import errno
import os
import resource
import shutil
from pathlib import Path

import numpy as np
import pytest

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import StoreError
from scanloom.schemas.product import Files
from tests.faults.crashing import asked
from tests.pipeline.reading import contents, leftovers, verdicts
from tests.pipeline.toys.products import Numbers, Smooth


class FullDisk:
    """Stands for `os.fsync` or `os.rename`; says from the n-th call on that the disk is full."""

    def __init__(self, call, allowed: int) -> None:
        self.call, self.allowed = call, allowed

    def __call__(self, *args, **kwargs):
        self.allowed -= 1
        if self.allowed < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self.call(*args, **kwargs)


@pytest.mark.parametrize(
    ("name", "allowed"), [("fsync", 0), ("fsync", 17), ("fsync", 60), ("rename", 5), ("mkdir", 9)]
)
def test_full_disk_stops_the_run_and_the_same_command_goes_on(tmp_path, store, monkeypatch, name, allowed):
    with monkeypatch.context() as patch:
        patch.setattr(os, name, FullDisk(getattr(os, name), allowed))
        with pytest.raises(StoreError, match="the disk is full") as caught:
            run(asked(tmp_path), store, cluster="none")
    assert "free some space" in caught.value.next_step
    assert "run the same command again" in caught.value.next_step
    assert leftovers(store) == []
    assert store.verify() == []

    undisturbed = Store(tmp_path / "undisturbed")
    run(asked(tmp_path), undisturbed, cluster="none")
    run(asked(tmp_path), store, cluster="none")
    assert contents(store) == contents(undisturbed)


def test_a_write_that_the_system_refuses_halfway(tmp_path, store):
    """The real thing, inside Arrow's writer: the limit on file size stands for the end of the disk."""
    rng = np.random.default_rng(1)
    big = Smooth(iter([Numbers(value=rng.integers(0, 1 << 60, 5000), index=i) for i in range(5)]))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
    try:
        with pytest.raises(StoreError, match="the disk is full"), store.draft("smooth", "0" * 64) as draft:
            draft.write(big, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert leftovers(store) == []


def test_a_store_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="cannot write the store"):
        Store(tmp_path / "file" / "store")


def test_a_flipped_bit_is_found_and_made_good(tmp_path, store):
    first = run(asked(tmp_path), store, cluster="none")
    before = contents(store)
    rng = np.random.default_rng(5)
    victims = [path for path in sorted(store.root.rglob("*")) if path.suffix == ".parquet"]
    victim = victims[rng.integers(len(victims))]
    _flip(victim, int(rng.integers(victim.stat().st_size * 8)))

    (problem,) = store.verify()
    assert problem.path == victim.relative_to(store.folder(problem.stage, problem.key)).as_posix()
    assert problem.what == "its bytes are not those that were written"
    assert Path(problem.moved_to).is_dir()
    assert store.verify() == []
    assert store.status().quarantined == 1

    result = run(asked(tmp_path), store, cluster="none")
    assert verdicts(result)[problem.stage]["RUN"] == 1
    assert result.executed == 1
    assert contents(store) == before
    assert [t.key for t in result.tasks] == [t.key for t in first.tasks]


@pytest.mark.parametrize("damage", ["cut", "gone", "manifest", "folder"])
def test_what_is_visibly_broken_is_made_again_at_once(tmp_path, store, damage):
    run(asked(tmp_path), store, cluster="none")
    before = contents(store)
    folder = sorted((store.root / "cut").iterdir())[2]
    victim = next(folder.rglob("*.parquet"))
    match damage:
        case "cut":
            os.truncate(victim, victim.stat().st_size - 1)
        case "gone":
            victim.unlink()
        case "manifest":
            (folder / "manifest.json").write_text("{")
        case "folder":
            shutil.rmtree(folder)
    result = run(asked(tmp_path), store, cluster="none")
    assert verdicts(result)["cut"] == {"HIT": 5, "RUN": 1}
    assert contents(store) == before


def test_a_manifest_of_another_key_is_found(tmp_path, store):
    run(asked(tmp_path), store, cluster="none")
    one, other, *_ = sorted((store.root / "cut").iterdir())
    shutil.copy(one / "manifest.json", other / "manifest.json")
    (problem,) = store.verify()
    assert (problem.key, problem.what) == (other.name, "the manifest belongs to another key")


def test_a_source_that_does_not_change_is_trusted_and_one_that_does_is_not(tmp_path, store):
    run(asked(tmp_path), store, cluster="none")
    source = tmp_path / "logs" / "a" / "log.txt"
    source.write_bytes(source.read_bytes().replace(b"29", b"28"))
    files = Files(root=source.parent, names=("log.txt",))
    assert store.hashes.of({"log": files.path("log.txt")}) != {}
    result = run(asked_again(tmp_path), store, cluster="none")
    assert verdicts(result)["read"] == {"HIT": 1, "RUN": 1}


def asked_again(folder: Path):
    """The same request without writing the logs anew."""
    from scanloom.pipeline.plan import Request, SessionInput
    from tests.pipeline.toys.products import Log
    from tests.pipeline.toys.workflow import NODES

    roots = [folder / "logs" / name for name in ("a", "b")]
    sessions = tuple(SessionInput(r.name, {Log: Log(root=r, names=("log.txt",))}) for r in roots)
    return Request(NODES, sessions)


def _flip(path: Path, bit: int) -> None:
    body = bytearray(path.read_bytes())
    body[bit // 8] ^= 1 << bit % 8
    path.write_bytes(body)
