"""The same map gives the same bytes, whatever the format."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanloom.stages.exports.formats import FORMATS
from scanloom.stages.exports.options import Options
from tests.stages.exports.tracks import MUNICH, START_NS, delivered, plane, poses_along, way

NAMES = ("tum", "kitti", "gpx", "geojson", "geoparquet", "dem", "orthophoto", "stac")


@pytest.mark.parametrize("name", NAMES)
def test_two_runs_agree(tmp_path: Path, name: str) -> None:
    for module in FORMATS[name].needs:
        pytest.importorskip(module)
    sessions = {
        "a": poses_along(way(6), MUNICH),
        "b": poses_along(way(3), MUNICH, start_ns=START_NS + 10**12),
    }
    source = delivered(tmp_path / "m", MUNICH, sessions, plane(3000))
    runs = []
    for run in ("one", "two"):
        folder = tmp_path / run
        folder.mkdir()
        paths = FORMATS[name].write(source, folder, Options())
        assert sorted(paths) == sorted(p for p in folder.rglob("*") if p.is_file()), (
            "nothing but what it names"
        )
        runs.append({path.name: path.read_bytes() for path in paths})
    assert runs[0] == runs[1]
    assert all(runs[0].values())
