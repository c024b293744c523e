"""The verb `export`: what it writes, records, skips and refuses."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput, ProductError, StoreError, UsageError
from scanloom.stages.exports import formats
from scanloom.stages.exports.options import Options
from scanloom.workflows.export_map import export_all, export_map, options_of, read_record
from tests.stages.exports.clouds import scattered, write
from tests.stages.exports.tracks import MUNICH, poses_along, way


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "m", scattered(1, 300))
    return tmp_path / "m"


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "scanloom.workflows.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_record_says_what_was_written(folder: Path) -> None:
    done = export_map(folder, "ply,pcd", Options())
    assert [entry.name for entry in done] == ["ply", "pcd"] and all(entry.fresh for entry in done)
    rows = read_record(folder / "exports")
    assert set(rows) == {"ply", "pcd"}
    row = rows["ply"]
    assert row["points"] == 300 and row["crs"]["epsg"] == 32632
    assert row["crs"]["heights"] == "above the WGS84 ellipsoid, m"
    assert row["made_from"]["map"] == hashlib.sha256((folder / "map.json").read_bytes()).hexdigest()
    assert set(row["made_from"]["versions"]) >= {"scanloom", "numpy", "pyproj"}
    for name, file in row["files"].items():
        content = (folder / "exports/ply" / name).read_bytes()
        assert file == {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    box = np.array(row["box_m"])
    assert np.all(box[0] < box[1]) and box[1, 1] - box[0, 1] < 200.0


def test_a_second_export_leaves_everything(folder: Path) -> None:
    export_map(folder, "pcd", Options())
    before = (folder / "exports/pcd/map.pcd").stat().st_mtime_ns
    assert not export_map(folder, "pcd", Options())[0].fresh
    assert (folder / "exports/pcd/map.pcd").stat().st_mtime_ns == before


def change_header(folder: Path) -> None:
    header = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(header | {"version": 2}))


def lose_a_file(folder: Path) -> None:
    (folder / "exports/pcd/map.json").unlink()


def cut_a_file(folder: Path) -> None:
    path = folder / "exports/pcd/map.pcd"
    path.write_bytes(path.read_bytes()[:-1])


def lose_the_record(folder: Path) -> None:
    (folder / "exports/exports.json").unlink()


def cut_the_record(folder: Path) -> None:
    path = folder / "exports/exports.json"
    path.write_text(path.read_text()[:50])


@pytest.mark.parametrize("change", [change_header, lose_a_file, cut_a_file, lose_the_record, cut_the_record])
def test_what_changed_is_exported_anew(folder: Path, change) -> None:
    export_map(folder, "pcd", Options())
    whole = (folder / "exports/pcd/map.pcd").read_bytes()
    change(folder)
    assert export_map(folder, "pcd", Options())[0].fresh
    assert (folder / "exports/pcd/map.pcd").read_bytes() == whole
    assert not export_map(folder, "pcd", Options())[0].fresh


def test_other_options_are_another_export(folder: Path) -> None:
    export_map(folder, "pcd", Options())
    assert export_map(folder, "pcd", Options(epsg=25832))[0].fresh
    assert read_record(folder / "exports")["pcd"]["crs"]["epsg"] == 25832


def test_a_format_of_a_new_version_is_written_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_map(folder, "pcd", Options())
    newer = replace(formats.FORMATS["pcd"], version=99)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS) | {"pcd": newer})
    assert export_map(folder, "pcd", Options())[0].fresh


def test_a_failed_export_leaves_the_old_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export_map(folder, "pcd", Options())
    whole = (folder / "exports/pcd/map.pcd").read_bytes()

    def breaks(source, place: Path, options) -> list[Path]:
        (place / "map.pcd").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    broken = replace(formats.FORMATS["pcd"], write=breaks, version=2)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS) | {"pcd": broken})
    with pytest.raises(StoreError, match="No space left"):
        export_map(folder, "pcd", Options())
    assert (folder / "exports/pcd/map.pcd").read_bytes() == whole
    assert read_record(folder / "exports")["pcd"]["made_from"]["format_version"] == 1
    assert sorted(p.name for p in (folder / "exports").iterdir()) == [".lock", "exports.json", "pcd"]


def test_leftovers_of_a_killed_export_go(folder: Path) -> None:
    left = folder / "exports/.pcd.part/deep"
    left.mkdir(parents=True)
    export_map(folder, "pcd", Options())
    assert not left.exists()


def test_killed_between_files_and_record(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scanloom.workflows import export_map as module

    export_map(folder, "pcd", Options())
    change_header(folder)
    monkeypatch.setattr(module, "_keep", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        export_map(folder, "pcd", Options())
    assert "pcd" not in read_record(folder / "exports")
    monkeypatch.undo()
    assert export_map(folder, "pcd", Options())[0].fresh


def test_another_folder(folder: Path, tmp_path: Path) -> None:
    done = export_map(folder, "pcd", Options(), tmp_path / "deep/elsewhere")
    assert done[0].folder == tmp_path / "deep/elsewhere/pcd" and not (folder / "exports").exists()


def test_two_at_once(folder: Path) -> None:
    (folder / "exports").mkdir()
    with (folder / "exports/.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another export"):
            export_map(folder, "pcd", Options())


@pytest.mark.parametrize(
    ("name", "near"),
    [("las", "did you mean laz"), ("plly", "did you mean ply"), ("autowar", "did you mean autoware")],
)
def test_an_unknown_format_names_the_nearest(folder: Path, name: str, near: str) -> None:
    with pytest.raises(UsageError) as caught:
        export_map(folder, f"pcd,{name}", Options())
    assert near in caught.value.next_step
    assert not (folder / "exports").exists()


def test_no_format(folder: Path) -> None:
    with pytest.raises(UsageError, match="no format"):
        export_map(folder, " , ", Options())


def test_a_missing_library_names_its_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lacking = replace(formats.FORMATS["laz"], needs=("no_such_module_anywhere",))
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS) | {"laz": lacking})
    with pytest.raises(UsageError, match="no_such_module_anywhere") as caught:
        export_map(folder, "laz", Options())
    assert "scanloom[las]" in caught.value.next_step


def no_index(folder: Path) -> None:
    (folder / "tiles/index.parquet").unlink()


def no_name(folder: Path) -> None:
    (folder / "map.json").write_text("[]")


def cut_index(folder: Path) -> None:
    path = folder / "tiles/index.parquet"
    path.write_bytes(path.read_bytes()[:-9])


@pytest.mark.parametrize(
    ("harm", "named"), [(no_index, "index.parquet"), (cut_index, "index.parquet"), (no_name, "map.json")]
)
def test_half_a_map(folder: Path, harm, named: str) -> None:
    harm(folder)
    with pytest.raises(InvalidInput, match=named) as caught:
        export_map(folder, "pcd", Options())
    assert "scanloom map" in caught.value.next_step and "Errno" not in str(caught.value)[:60]


def test_not_a_map(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="holds no map"):
        export_map(tmp_path, "pcd", Options())


@pytest.mark.parametrize("name", ["ply", "pcd", "laz", "copc", "autoware"])
@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-9])])
def test_a_map_with_a_broken_tile(folder: Path, name: str, harm) -> None:
    if name in ("laz", "copc"):
        pytest.importorskip("laspy")
    harm(folder / "tiles/0_0.parquet")
    with pytest.raises((InvalidInput, ProductError), match=r"0_0\.parquet"):
        export_map(folder, name, Options())
    assert sorted(p.name for p in (folder / "exports").iterdir()) == [".lock"]


def test_a_file_where_the_folder_should_be(folder: Path) -> None:
    (folder / "exports").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        export_map(folder, "pcd", Options())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written(folder: Path, tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(StoreError, match="cannot be written"):
        export_map(folder, "pcd", Options(), closed / "exports")


@pytest.mark.parametrize("fields", [{"epsg": 7}, {"heights": "sideways"}, {"vertical_epsg": 10**7}])
def test_options_out_of_bounds(fields: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="--"):
        options_of(**fields)


def test_the_command_line(folder: Path) -> None:
    done = run("export", str(folder), "--format", "pcd,ply", "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [(row["format"], row["fresh"]) for row in rows] == [("pcd", True), ("ply", True)]
    again = run("export", str(folder), "--format", "pcd")
    assert "unchanged" in again.stdout


def test_the_command_line_refuses(folder: Path, tmp_path: Path) -> None:
    unknown = run("export", str(folder), "--format", "pcdd")
    assert unknown.returncode == 2 and "did you mean pcd" in unknown.stderr
    nothing = run("export", str(tmp_path), "--format", "pcd")
    assert nothing.returncode == 4 and "holds no map" in nothing.stderr
    assert run("export", "--format", "pcd").returncode == 2
    early = run("map", "sample", "--out", str(tmp_path / "out"), "--export", "pcdd")
    assert early.returncode == 2 and not (tmp_path / "out").exists()


def test_after_a_map(folder: Path) -> None:
    from scanloom.workflows.build_map import Outcome
    from scanloom.workflows.cli import _export_after

    outcome = Outcome(
        out=folder, exit_code=0, delivered=True, metrics=[], executed=1, warnings=[], failures=[]
    )
    assert _export_after(outcome, "") == (outcome, [])
    after, done = _export_after(outcome, "pcd,ply")
    assert [entry.name for entry in done] == ["pcd", "ply"] and after == outcome
    failed = replace(outcome, delivered=False)
    assert _export_after(failed, "laz") == (failed, [])
    assert not (folder / "exports/laz").exists()


def full_disk(source, place: Path, options) -> list[Path]:
    (place / "half").write_bytes(b"half")
    raise OSError(28, "No space left on device")


def surprise(source, place: Path, options) -> list[Path]:
    raise ZeroDivisionError("float division by zero")


@pytest.mark.parametrize(("breaks", "why"), [(full_disk, "No space left"), (surprise, "ZeroDivisionError")])
def test_one_that_fails_stops_no_other(
    folder: Path, monkeypatch: pytest.MonkeyPatch, breaks, why: str
) -> None:
    from scanloom.workflows.build_map import Outcome
    from scanloom.workflows.export_after import export_after

    broken = replace(formats.FORMATS["ply"], write=breaks)
    monkeypatch.setattr(formats, "FORMATS", dict(formats.FORMATS) | {"ply": broken})
    outcome = Outcome(
        out=folder, exit_code=0, delivered=True, metrics=[], executed=1, warnings=[], failures=[]
    )
    after, done = export_after(outcome, "ply,pcd")
    assert [entry.name for entry in done] == ["pcd"] and after.exit_code == 3 and after.delivered
    assert [(where, why in str(error)) for where, error in after.failures] == [("export ply", True)]
    assert sorted(p.name for p in (folder / "exports").iterdir()) == [".lock", "exports.json", "pcd"]


class Notes:
    """Progress that remembers."""

    def __init__(self) -> None:
        self.told: list[tuple[str, int, int, int]] = []
        self.ended = 0

    def begin(self, stages) -> None:
        self.titles = dict(stages)

    def update(self, counts) -> None:
        self.told += [(name, *row) for name, row in counts.items()]

    def note(self, text: str) -> None: ...

    def end(self) -> None:
        self.ended += 1


@pytest.mark.parametrize(
    "name", ["ply", "pcd", "laz", "copc", "autoware", "3dtiles", "dem", "orthophoto", "tum"]
)
def test_progress_counts_tiles(folder: Path, name: str) -> None:
    entry = formats.FORMATS[name]
    for module in entry.needs:
        pytest.importorskip(module)
    write_track(folder)
    heard = Notes()
    _, failures = export_all(folder, name, Options(), progress=heard)
    assert failures == [] and heard.ended == 1 and name in heard.titles[name]
    tiles = len(list((folder / "tiles").glob("*_*.parquet")))
    over = [row[1] for row in heard.told]
    total = max(entry.passes * tiles, 1)
    assert {row[3] for row in heard.told} == {total} and over == sorted(over)
    assert heard.told[0] == (name, 0, 1, total) and heard.told[-1] == (name, total, 0, total)
    if entry.passes:
        assert len(set(over)) > tiles // 2 or name == "3dtiles", "a small map is one file of 3D Tiles"
    before = len(heard.told)
    export_all(folder, name, Options(), progress=heard)
    assert heard.told[before:] == [(name, 0, 1, total)], "what is unchanged is not said to be done"


def write_track(folder: Path) -> None:
    along = way(4)
    (folder / "trajectory").mkdir(exist_ok=True)
    poses_along(along, MUNICH).write(folder / "trajectory/a.parquet")


def test_trajectories_have_no_points_on_record(folder: Path) -> None:
    export_map(folder, "pcd,tum", Options())
    assert "points" in read_record(folder / "exports")["pcd"]
    assert "points" not in read_record(folder / "exports")["tum"]


def test_the_list() -> None:
    listed = json.loads(run("export", "--list", "--json").stdout)
    assert {"ply", "pcd", "laz", "copc", "autoware"} <= {row["format"] for row in listed}
