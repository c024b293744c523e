"""`extend` from the outside: what stays, what is new, what has gone, and what is said when it cannot be."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scanloom.schemas.changes import Changes
from scanloom.schemas.errors import EXIT_SOME_FAILED, InvalidInput, UsageError
from scanloom.schemas.tiles import TileIndex
from scanloom.schemas.trajectory import Poses
from scanloom.workflows.build_map import Order, Outcome, build_map, plan_map
from scanloom.workflows.configuration import merged
from scanloom.workflows.extend_map import extension_order, moved_logs
from scanloom.workflows.parent import read_parent
from scanloom.workflows.sessions import find_sessions
from tests.workflows.test_map import scanloom
from tests.worlds import GROUND_Z_M, BoxWorld, drive, street

TILES = {"tiling": {"tile_size_m": 20.0}}
CAR = [[12.0, 2.6, GROUND_Z_M], [16.3, 4.4, GROUND_Z_M + 1.5]]
"""Parked on Monday."""


def log(folder: Path, world: BoxWorld, count: int, seed: int) -> Path:
    """KITTI-style scans along an arc through a world; no IMU, no GNSS, no times."""
    folder.mkdir(parents=True)
    scans, _ = drive(world, count, step_m=0.8, yaw_step_rad=0.01, seed=seed)
    for i, scan in enumerate(scans):
        np.column_stack((scan.points(), scan.intensity)).astype("<f4").tofile(folder / f"{i:06d}.bin")
    return folder


def town(*, car: bool, seed: int = 0) -> BoxWorld:
    """A street without other cars on the left, near the drive."""
    boxes = street(seed, length_m=60).boxes
    parked = (boxes[:, 1, 2] == GROUND_Z_M + 1.5) & (boxes[:, 0, 1] > 0)
    return BoxWorld(np.concatenate((boxes[~parked], np.array([CAR]))) if car else boxes[~parked])


def extended(
    folder: Path, words: list[str], *, parent: str = "monday", out: str | None = None, mode: str = "rigid",
    moved: dict[str, str] | None = None,
) -> Order:  # fmt: skip
    """The order for an extension of the map of Monday."""
    return extension_order(
        read_parent(folder / "maps" / parent, moved), words, out=folder / "maps" / out if out else None, store=None,
        mode=mode, project={}, command_line={}, cluster="none",
    )  # fmt: skip


def made(order: Order) -> Outcome:
    outcome = build_map(order)
    assert not outcome.failures, [str(error) for _, error in outcome.failures]
    return outcome


def described(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "map.json").read_text())
    return content


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Monday, mapped, and Tuesday's log, of a drive that ends earlier and meets one car less."""
    folder: Path = tmp_path_factory.mktemp("extend")
    log(folder / "logs" / "monday", town(car=True), 40, seed=0)
    log(folder / "logs" / "tuesday", town(car=False), 36, seed=1)
    order = Order(
        (str(folder / "logs" / "monday"),), folder / "maps" / "monday", "monday", folder / "store", "none",
        command_line=TILES,
    )  # fmt: skip
    made(order)
    return folder


@pytest.fixture(scope="module")
def second(world: Path) -> Outcome:
    """Monday's map, extended by Tuesday."""
    return made(extended(world, [str(world / "logs" / "tuesday")]))


def test_the_new_version_knows_its_parent(world: Path, second: Outcome) -> None:
    import hashlib

    assert second.out == world / "maps" / "monday-v2"
    content = described(second.out)
    sha256 = hashlib.sha256((world / "maps/monday/map.json").read_bytes()).hexdigest()
    assert content["parent"] == {"name": "monday", "version": 1, "sha256": sha256}
    assert content["version"] == 2
    assert [row["name"] for row in content["sessions"]] == ["monday", "tuesday"]
    assert str(world) not in (second.out / "map.json").read_text()


def test_old_poses_and_tiles_out_of_reach_stay_byte_by_byte(world: Path, second: Outcome) -> None:
    before, after = described(world / "maps/monday")["files"], described(second.out)["files"]
    assert after["trajectory/monday.parquet"] == before["trajectory.parquet"]
    index = TileIndex.open(second.out / "tiles/index.parquet")
    alone = [str(name) for name, who in zip(index.tile, index.sessions, strict=True) if who == "monday"]
    assert alone and len(alone) < len(index)
    for name in alone:
        for file in (f"tiles/{name}.parquet", f"tiles/{name}.ply"):
            assert after[file] == before[file]
    assert described(second.out)["tile_size_m"] == 20.0


def test_the_new_session_lies_on_the_old_one(second: Outcome) -> None:
    a, b = (Poses.open(second.out / f"trajectory/{name}.parquet") for name in ("monday", "tuesday"))
    n = min(len(a), len(b))
    apart = np.linalg.norm(a.T_world_lidar[:n, :3, 3] - b.T_world_lidar[:n, :3, 3], axis=1)
    assert 0.0005 < apart.max() < 0.1


def test_what_left_is_reported_and_stays_in_the_map(world: Path, second: Outcome) -> None:
    changes = Changes.open(second.out / "changes.parquet")
    points = np.column_stack((changes.x_m, changes.y_m, changes.z_m))
    low, high = np.array(CAR)
    assert list(changes.sessions) == ["tuesday"]
    assert set(changes.object_) == {0} and len(points) > 50
    assert ((points > low - 0.5) & (points < high + 0.5)).all()
    values = {row["name"]: row["value"] for row in second.metrics}
    assert values["changes.objects"] == 1 and values["changes.points"] == len(points)
    index = TileIndex.open(second.out / "tiles/index.parquet")
    assert index.points.sum() >= TileIndex.open(world / "maps/monday/tiles/index.parquet").points.sum()


def test_changes_open_as_a_cloud(second: Outcome) -> None:
    import open3d

    cloud = open3d.io.read_point_cloud(str(second.out / "changes.ply"))
    assert len(cloud.points) == len(Changes.open(second.out / "changes.parquet"))


def test_a_map_that_extends_none_has_no_changes(world: Path) -> None:
    names = {p.name for p in (world / "maps/monday").iterdir()}
    assert not names & {"changes.parquet", "changes.ply"}
    assert described(world / "maps/monday")["parent"] is None


def test_again_computes_nothing_and_changes_no_byte(world: Path, second: Outcome) -> None:
    before, parent = bytes_of(second.out), bytes_of(world / "maps/monday")
    again = made(extended(world, [str(world / "logs" / "tuesday")]))
    assert again.executed == 0
    assert bytes_of(second.out) == before
    assert bytes_of(world / "maps/monday") == parent


def test_other_settings_that_alter_old_tiles_are_named(world: Path, second: Outcome) -> None:
    assert not second.warnings
    order = extended(world, [str(world / "logs" / "tuesday")], out="coarse")
    coarse = replace(order, command_line=merged(order.command_line, {"tiles": {"min_points": 2}}))
    (warning,) = made(coarse).warnings
    assert "are not as in monday" in warning and "other settings" in warning


def test_soft_gives_a_map_too(world: Path) -> None:
    outcome = made(extended(world, [str(world / "logs" / "tuesday")], out="soft", mode="soft"))
    a = Poses.open(outcome.out / "trajectory/monday.parquet")
    b = Poses.open(world / "maps/monday/trajectory.parquet")
    moved = np.linalg.norm(a.T_world_lidar[:, :3, 3] - b.T_world_lidar[:, :3, 3], axis=1)
    assert ((moved == 0) | (moved > 1e-12)).all() and moved.max() < 0.2
    assert json.loads((outcome.out / "sources.json").read_text())["settings"] == TILES


def test_order_of_sessions_does_not_matter(world: Path) -> None:
    logs = [str(world / "logs" / name) for name in ("monday", "tuesday")]
    out = {}
    for words in (logs, logs[::-1]):
        order = Order(
            tuple(words), world / "maps" / f"from-{Path(words[0]).name}", "both", world / "store", "none",
            command_line=TILES,
        )  # fmt: skip
        out[words[0]] = made(order).out
    first, last = (described(folder) for folder in out.values())
    assert first == last


def test_names_do_not_depend_on_the_order(tmp_path: Path) -> None:
    logs = [log(tmp_path / day / "drive", town(car=True), 2, seed=0) for day in ("b", "a")]
    for words in (logs, logs[::-1]):
        found, errors = find_sessions([str(word) for word in words], {"drive-2"})
        assert [(s.name, s.word) for s in found] == [("drive", str(logs[1])), ("drive-3", str(logs[0]))]
        assert not errors


def test_an_extended_map_can_be_extended(world: Path, second: Outcome) -> None:
    log(world / "logs" / "wednesday", town(car=False), 30, seed=2)
    order = extended(world, [str(world / "logs" / "wednesday")], parent="monday-v2")
    assert order.out == world / "maps" / "monday-v3"
    tasks, errors = plan_map(order)
    assert not errors
    odometry = {t.coordinate["session"]: t.verdict for t in tasks if t.node == "odometry"}
    assert odometry["monday"] == odometry["tuesday"] == "HIT" and odometry["wednesday"] != "HIT"


# --- what cannot be -------------------------------------------------------------------------------------------------


def test_a_session_that_meets_none_does_not_stop_the_other(world: Path, second: Outcome) -> None:
    log(world / "logs" / "elsewhere", town(car=False, seed=7), 30, seed=3)
    words = [str(world / "logs" / name) for name in ("elsewhere", "tuesday")]
    outcome = build_map(extended(world, words, out="without"))
    assert outcome.delivered and outcome.exit_code == EXIT_SOME_FAILED
    ((place, error),) = outcome.failures
    assert place == "session elsewhere" and "ties it to the others" in str(error) and "Next:" in str(error)
    content = described(outcome.out)
    assert [row["name"] for row in content["sessions"]] == ["monday", "tuesday"]
    assert (
        content["files"]["trajectory/monday.parquet"]
        == described(second.out)["files"]["trajectory/monday.parquet"]
    )


def test_a_map_is_not_extended_by_a_session_that_never_meets_it(world: Path) -> None:
    if not (world / "logs" / "elsewhere").exists():
        log(world / "logs" / "elsewhere", town(car=False, seed=7), 30, seed=3)
    outcome = build_map(extended(world, [str(world / "logs" / "elsewhere")], out="nothing"))
    assert not outcome.delivered and outcome.exit_code != 0
    assert any("nothing ties this session" in str(error) for _, error in outcome.failures)


Harm = Callable[[Path], None]


def _edit(name: str, change: Callable[[dict[str, Any]], Any]) -> Harm:
    def harm(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content)
        (folder / name).write_text(json.dumps(content))

    return harm


HARMS: dict[str, tuple[Harm, str]] = {
    "no map": (shutil.rmtree, "holds no map"),
    "no map.json": (lambda f: (f / "map.json").unlink(), "holds no map"),
    "cut map.json": (lambda f: (f / "map.json").write_text("{"), "no JSON object"),
    "list": (lambda f: (f / "map.json").write_text("[]"), "no JSON object"),
    "other version": (_edit("map.json", lambda c: c.update(format="scanloom map 2")), "'scanloom map 2'"),
    "no format": (_edit("map.json", lambda c: c.pop("format")), "format None"),
    "no sessions": (_edit("map.json", lambda c: c.pop("sessions")), "entries are missing"),
    "no sources": (lambda f: (f / "sources.json").unlink(), "sources.json: is missing"),
    "cut sources": (lambda f: (f / "sources.json").write_text("{"), "is damaged"),
    "other sources": (_edit("sources.json", lambda c: c.update(format="x")), "is of format 'x'"),
    "fewer sources": (_edit("sources.json", lambda c: c.update(sessions=[])), "log of session monday"),
    "bent": (lambda f: (f / "trajectory.parquet").write_bytes(b"x"), "its checksum differs"),
    "no poses": (lambda f: (f / "trajectory.parquet").unlink(), "trajectory.parquet: cannot be read"),
}


@pytest.mark.parametrize(("harm", "said"), HARMS.values(), ids=HARMS.keys())
def test_a_map_that_cannot_be_used_is_an_error_that_says_why(
    world: Path, tmp_path: Path, harm: Harm, said: str
) -> None:
    shutil.copytree(world / "maps" / "monday", tmp_path / "copy")
    harm(tmp_path / "copy")
    with pytest.raises(InvalidInput) as error:
        read_parent(tmp_path / "copy")
    assert said in str(error.value) and error.value.next_step and error.value.where


def test_a_log_that_moved_is_found_again(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "maps" / "monday", tmp_path / "maps" / "monday")
    gone, now = tmp_path / "gone", tmp_path / "now"
    _edit("sources.json", lambda c: c["sessions"][0].update(word=str(gone)))(tmp_path / "maps/monday")
    with pytest.raises(InvalidInput, match=r"session monday.*--log monday=PATH") as error:
        read_parent(tmp_path / "maps/monday")
    assert error.value.where == str(gone)
    shutil.copytree(world / "logs" / "monday", now)
    parent = read_parent(tmp_path / "maps/monday", moved_logs([f"monday={now}"]))
    assert parent.sessions[0].word == str(now) and parent.sessions[0].name == "monday"


def test_another_log_in_its_place_is_refused(world: Path, tmp_path: Path) -> None:
    other = log(tmp_path / "other", town(car=True), 3, seed=8)
    with pytest.raises(InvalidInput, match="not the one the map was made of"):
        plan_map(extended(world, [str(world / "logs" / "tuesday")], moved={"monday": str(other)}))


@pytest.mark.parametrize(
    ("assignment", "said"),
    [("monday", "NAME=PATH"), ("=x", "NAME=PATH"), ("sunday=/x", "no session of that name")],
)
def test_log_must_name_a_session_and_a_path(world: Path, assignment: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read_parent(world / "maps" / "monday", moved_logs([assignment]))


def test_a_log_enters_a_map_once(world: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(world / "logs" / "monday", copy)
    for word in (world / "logs" / "monday", copy):
        tasks, errors = plan_map(extended(world, [str(word)]))
        ((_, error),) = errors
        assert not tasks and isinstance(error, UsageError) and "as session monday" in str(error)


def test_the_map_itself_is_never_overwritten(world: Path) -> None:
    with pytest.raises(UsageError, match="left as it is"):
        extended(world, [str(world / "logs" / "tuesday")], out="monday")


def test_the_command_says_what_is_wrong_in_one_sentence(world: Path) -> None:
    done = scanloom("extend", "maps/none", "logs/tuesday", cwd=world)
    assert done.returncode == 4
    assert "maps/none" in done.stderr and "Next:" in done.stderr and "Traceback" not in done.stderr


def test_the_command_plans(world: Path) -> None:
    done = scanloom("extend", "maps/monday", "logs/tuesday", "--dry-run", "--json", cwd=world)
    assert done.returncode == 0, done.stderr
    tasks = json.loads(done.stdout)["tasks"]
    assert {t["coordinate"]["session"] for t in tasks if t["node"] == "base"} == {"monday", "tuesday"}
