"""`status`, `verify`, `explain` and `gc` from the outside: what they print about a small store."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Artifact, Store
from scanloom.schemas.errors import UsageError
from scanloom.workflows.cli import app
from tests.pipeline.toys.workflow import log, request

A = range(30)
MADE = {"read": 1, "smooth": 3, "track": 1, "join": 1, "cut": 3, "paint": 3, "survey": 1}
"""Artifacts of one session of the toy workflow."""
TOTAL = sum(MADE.values())


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """What one run has made."""
    store = Store(tmp_path / "store")
    run(request(log(tmp_path, "a", A)), store, cluster="none")
    return store


def wider(tmp_path: Path, store: Store) -> None:
    """Another run, of which three stages differ from the first."""
    run(request(log(tmp_path, "a", A), settings={"cut": {"width": 7}}), store, cluster="none")


def scanloom(store: Store, *words: str) -> Result:
    return CliRunner().invoke(app, [*words, "--store", str(store.root)])


def lines(store: Store, *words: str) -> list[str]:
    done = scanloom(store, *words)
    assert done.exit_code == 0, done.output
    return done.output.splitlines()


def damage(artifact: Artifact) -> Path:
    """Turn one bit of its first file."""
    path = artifact.path(artifact.parts[0])
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    return path


def half_written(store: Store) -> None:
    """What a killed process leaves behind."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    folder = store.root / "tmp" / f"x.{process.pid}.{socket.gethostname()}"
    folder.mkdir()
    (folder / "half.parquet").write_bytes(bytes(300_000))


def test_status_tells_stages_runs_and_failures(tmp_path: Path, store: Store) -> None:
    run(request(log(tmp_path, "bad", A, "broken")), store, cluster="none")
    said = lines(store, "status")
    assert re.fullmatch(rf"{re.escape(str(store.root))}   \d+\.\d MB", said[0])
    stages = [line.split() for line in said if " artifacts " in line]
    assert {words[0]: int(words[1]) for words in stages} == MADE
    runs = [line.split() for line in said if line.startswith("run ")]
    assert [(words[1], words[5]) for words in runs] == [("2", "finished"), ("1", "finished")]
    assert [" ".join(words[8:]) for words in runs] == ["1 FAILED, 3 SKIPPED", f"{TOTAL} RUN"]
    assert said[-1].startswith("failed: read-session-bad: ") and "the log is broken" in said[-1]


def test_status_tells_what_gc_would_clear_away(store: Store) -> None:
    assert not any("leftovers" in line for line in lines(store, "status"))
    half_written(store)
    assert lines(store, "status")[-1] == "1 leftovers, 0 in quarantine; `scanloom gc` removes them"
    assert lines(store, "gc", "--dry-run") == ["would free 0.3 MB in 0 artifacts and 1 leftovers"]
    assert lines(store, "gc") == ["freed 0.3 MB in 0 artifacts and 1 leftovers"]
    assert lines(store, "gc") == ["freed 0.0 MB in 0 artifacts"]
    assert not any("leftovers" in line for line in lines(store, "status"))


def test_verify_names_what_is_damaged_and_sets_it_aside(store: Store) -> None:
    assert lines(store, "verify") == [f"{TOTAL} artifacts checked, 0 damaged"]
    artifact = next(iter(store.artifacts("join")))
    path = damage(artifact)
    done = scanloom(store, "verify")
    assert done.exit_code == 1
    problem, total = done.output.splitlines()
    assert problem.startswith(f"join/{artifact.key}: {path.relative_to(artifact.folder)}: its bytes are not")
    assert total == f"{TOTAL} artifacts checked, 1 damaged"
    assert Path(problem.rpartition("moved to ")[2]).is_dir() and not artifact.folder.exists()
    assert lines(store, "verify") == [f"{TOTAL - 1} artifacts checked, 0 damaged"]
    assert lines(store, "status")[-1] == "0 leftovers, 1 in quarantine; `scanloom gc` removes them"


def test_gc_keeps_what_it_is_told_to(tmp_path: Path, store: Store) -> None:
    wider(tmp_path, store)
    before = {a.key for a in store.artifacts()}
    old = MADE["cut"] + MADE["paint"] + MADE["survey"]
    assert lines(store, "gc", "--keep-runs", "2") == ["freed 0.0 MB in 0 artifacts"]
    (would,) = lines(store, "gc", "--keep-runs", "1", "--dry-run")
    assert re.fullmatch(rf"would free \d+\.\d MB in {old} artifacts", would)
    assert {a.key for a in store.artifacts()} == before
    assert lines(store, "gc", "--keep-runs", "1") == [would.replace("would free", "freed")]
    assert len(list(store.artifacts())) == len(before) - old


def test_explain_tells_what_an_artifact_was_made_of(store: Store) -> None:
    artifact = next(iter(store.artifacts("read")))
    said = lines(store, "explain", artifact.key[:12])
    assert said[0] == f"read a   {artifact.key}"
    assert said[1] == f"in {artifact.folder}"
    assert said[2].startswith('settings  {"chunk_items": 2')
    assert said[3].startswith("code      ") and "tests.pipeline.toys.read" in said[3]
    assert said[4] == "reads     log (1 part) made by a file from outside"
    wrote = [line.split()[1] for line in said if line.startswith("wrote ")]
    assert sorted(wrote) == sorted(f.path for part in artifact.parts for f in part.files)
    assert not any(line.startswith("since ") for line in said)
    assert lines(store, "explain", str(artifact.folder)) == said


def test_explain_tells_who_made_the_inputs_and_what_changed(tmp_path: Path, store: Store) -> None:
    first = next(iter(store.artifacts("join")))
    tracks = next(iter(store.artifacts("track")))
    assert f"reads     track (1 part) made by track/{tracks.key}" in lines(store, "explain", first.key)
    run(request(log(tmp_path, "a", A), settings={"join": {"spacing": 100}}), store, cluster="none")
    (second,) = (a for a in store.artifacts("join") if a.key != first.key)
    assert re.fullmatch(
        rf"since {first.key[:16]}: settings\.join\.spacing \d+ -> 100",
        lines(store, "explain", second.key)[-1],
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("explain", "zzz"), "no artifact has a key that starts with 'zzz'"),
        (("explain", ""), f"{TOTAL} artifacts have such a key"),
    ],
)
def test_a_key_must_name_one_artifact(store: Store, words: tuple[str, ...], message: str) -> None:
    error = scanloom(store, *words).exception
    assert isinstance(error, UsageError) and message in str(error)


@pytest.mark.parametrize("verb", [("status",), ("verify",), ("gc",), ("explain", "a")])
def test_without_a_store_it_is_said_so(tmp_path: Path, verb: tuple[str, ...]) -> None:
    error = CliRunner().invoke(app, [*verb, "--store", str(tmp_path / "nowhere")]).exception
    assert isinstance(error, UsageError) and "there is no store here" in str(error)
    assert not (tmp_path / "nowhere").exists()
