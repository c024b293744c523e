"""Killed at any moment, the same command goes on, and ends with the bytes of an undisturbed run."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from tests.faults.crashing import asked
from tests.faults.running import slow
from tests.pipeline.conftest import ROOT
from tests.pipeline.reading import contents, leftovers


def python(module: str, *arguments: object) -> subprocess.Popen[str]:
    """In a process group of its own."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)


@pytest.mark.parametrize("seed", [1, 2])
def test_killed_at_every_step_of_publishing(tmp_path, seed):
    undisturbed = Store(tmp_path / "undisturbed")
    run(asked(tmp_path), undisturbed, cluster="none")
    died, _ = python("tests.faults.crashing", tmp_path, seed).communicate(timeout=180)
    assert int(died) >= 8
    survived = Store(tmp_path / "store")
    assert contents(survived) == contents(undisturbed)
    assert survived.verify() == []

    again = run(asked(tmp_path), survived, cluster="none")
    assert again.executed == 0
    assert leftovers(survived) == []
    assert {r.state for r in survived.status().runs} <= {"killed", "finished"}


@pytest.mark.parametrize(("cluster", "seed"), [("none", 1), ("none", 2), ("local", 3)])
def test_killed_from_outside_at_a_random_moment(tmp_path, cluster, seed):
    undisturbed = Store(tmp_path / "undisturbed")
    run(slow(tmp_path, 0.03), undisturbed, cluster="none")
    rng = random.Random(seed)
    process = python("tests.faults.running", tmp_path, cluster, 0.03)
    assert process.stdout is not None
    process.stdout.readline()
    if cluster == "local":
        _wait_for_first_artifact(tmp_path / "store", process)
    time.sleep(rng.uniform(0.05, 0.4))
    family = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    _, alive = psutil.wait_procs(family, timeout=10)
    assert alive == [], "workers outlive the run they belong to"

    survived = Store(tmp_path / "store")
    assert survived.verify() == []
    output, _ = python("tests.faults.running", tmp_path, cluster, 0.03).communicate(timeout=180)
    assert "executed" in output
    assert contents(survived) == contents(undisturbed)
    assert leftovers(survived) == []


def test_interrupted_from_the_keyboard(tmp_path):
    """Ctrl-C reaches the whole group: no zombie workers, a consistent store, a record that says so."""
    process = python("tests.faults.running", tmp_path, "local", 0.5)
    _wait_for_first_artifact(tmp_path / "store", process)
    family = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(timeout=20) != 0
    _, alive = psutil.wait_procs(family, timeout=10)
    assert alive == []
    interrupted = Store(tmp_path / "store")
    assert interrupted.status().runs[0].state == "interrupted"
    assert interrupted.verify() == []
    assert 2 <= len(list(interrupted.artifacts())) < 24


def _wait_for_first_artifact(folder: Path, process: subprocess.Popen[str]) -> None:
    for _ in range(3000):
        if any(folder.glob("read/*/manifest.json")):
            return
        assert process.poll() is None, "the run ended too early"
        time.sleep(0.02)
    raise AssertionError("the run did not get going")
