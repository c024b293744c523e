"""A recording that was cut off: what is there is mapped and what is lost is said; too little is refused with a reason."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.mapped import Mapped
from tests.workflows.test_map import scanloom


@pytest.fixture(scope="module")
def whole_log(small: Mapped) -> Path:
    """The small sample's MCAP file."""
    (artifact,) = small.store.artifacts("simulate")
    (path,) = artifact.folder.rglob("*.mcap")
    return path


def _cut(log: Path, folder: Path, share: float) -> Path:
    data = log.read_bytes()
    path = folder / "cut.mcap"
    path.write_bytes(data[: int(len(data) * share)])
    return path


def test_first_half_is_mapped_with_a_warning(whole_log: Path, tmp_path: Path) -> None:
    _cut(whole_log, tmp_path, 0.5)
    done = scanloom("map", "cut.mcap", "--out", "out", "--cluster", "none", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert any("cut" in text or "missing" in text or "lost" in text for text in said["warnings"]), said[
        "warnings"
    ]
    scans = next(row["value"] for row in said["metrics"] if row["name"] == "odometry.scans")
    assert 20 <= scans <= 60


def test_cut_before_the_second_scan_is_refused(whole_log: Path, tmp_path: Path) -> None:
    _cut(whole_log, tmp_path, 0.002)
    done = scanloom("map", "cut.mcap", "--out", "out", cwd=tmp_path)
    assert done.returncode == 4, done.stderr
    assert "Traceback" not in done.stderr
    assert "Next:" in done.stderr
