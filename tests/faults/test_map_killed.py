"""`kill -9` of a real map at random moments, then the same command: the same bytes as an undisturbed run."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.logs import scan_folder

VARIES = {"metrics.json", "report.html", "sources.json"}
"""Times of the run, and places on this machine."""
"""They name times and memory of the run."""


def _start(folder: Path, workers: int) -> subprocess.Popen[bytes]:
    words = ["map", "log", "--out", "out", "--workers", str(workers), "--set", "ingest.chunk_s=1"]
    return subprocess.Popen(
        [sys.executable, "-m", "scanloom.workflows.cli", *words],
        cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def _delivered(folder: Path) -> dict[str, bytes]:
    out = folder / "out"
    return {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.name not in VARIES
    }


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], float]:
    """What one worker delivers when nothing goes wrong, and how long it takes, s."""
    folder = tmp_path_factory.mktemp("undisturbed")
    scan_folder(folder / "log", count=20)
    started = time.monotonic()
    process = _start(folder, workers=1)
    assert process.wait(timeout=300) == 0, process.stderr.read().decode() if process.stderr else ""
    return _delivered(folder), time.monotonic() - started


@pytest.mark.parametrize("seed", range(3))
def test_killed_and_started_again(
    undisturbed: tuple[dict[str, bytes], float], tmp_path: Path, seed: int
) -> None:
    expected, wall_s = undisturbed
    scan_folder(tmp_path / "log", count=20)
    rng = random.Random(seed)
    for _ in range(2):
        process = _start(tmp_path, workers=2)
        time.sleep(rng.uniform(0.2, 0.9) * wall_s)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    process = _start(tmp_path, workers=2)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said.decode()
    assert _delivered(tmp_path) == expected
