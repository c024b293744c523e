"""A session in windows: one task each, the same bytes however many workers take them, and no task when it is not cut."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scanloom.pipeline.plan import plan
from scanloom.pipeline.run import Result
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import UsageError
from scanloom.schemas.product import columns_of
from scanloom.schemas.scans import Deskewed
from scanloom.schemas.trajectory import Odometry
from scanloom.schemas.windows import Track, TrackEnds, Window
from scanloom.workflows.build_map import request_of
from tests.mapped import SMALL, Mapped, order, track_in_windows

PRODUCTS = (Window, Track, TrackEnds, Odometry)


def bytes_of(result: Result) -> dict[str, list[bytes]]:
    return {p.NAME: [path.read_bytes() for _, path in result.files(p)] for p in PRODUCTS}


@pytest.fixture(scope="module")
def here(small: Mapped, tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    return track_in_windows(small, tmp_path_factory.mktemp("here"))


def test_each_window_is_a_task_of_its_own(here: Mapped) -> None:
    tracks = [task for task in here.result.tasks if task.node == "track"]
    assert [task.coordinate["window"] for task in tracks] == ["0000", "0001", "0002"]
    assert {task.node for task in here.result.tasks if task.verdict == "RUN"} == {
        "windows",
        "track",
        "odometry",
    }


@pytest.mark.parametrize("workers", [1, 2])
def test_the_same_bytes_with_any_number_of_workers(
    workers: int, small: Mapped, here: Mapped, tmp_path: Path
) -> None:
    spread = track_in_windows(small, tmp_path, cluster="local", workers=workers)
    assert bytes_of(spread.result) == bytes_of(here.result)
    assert len(bytes_of(here.result)["track_ends"]) == 3


def test_the_windows_own_all_scans_of_the_session(here: Mapped) -> None:
    windows, count = list(here.result.parts(Window)), sum(len(chunk) for chunk in here.result.parts(Deskewed))
    assert [w.own for w in windows] == [0, *(w.last for w in windows[:-1])]
    assert windows[-1].last == count
    (odometry,) = here.result.parts(Odometry)
    assert odometry.scan_index.tolist() == list(range(count))
    assert [len(t) for t in here.result.parts(Track)] == [w.last - w.first for w in windows]


def test_windows_end_where_the_whole_run_ends(small: Mapped, here: Mapped) -> None:
    (whole,), (joined,) = small.result.parts(Odometry), here.result.parts(Odometry)
    apart = np.linalg.norm((whole.T_odom_lidar[-1] - joined.T_odom_lidar[-1])[:3, 3])
    assert 1e-6 < apart < 0.1


def test_one_window_is_no_window(small: Mapped, tmp_path: Path) -> None:
    once = track_in_windows(small, tmp_path, windows=1)
    assert {task.node for task in small.result.tasks}.isdisjoint({"track"})
    assert {task.node for task in once.result.tasks}.isdisjoint({"track"})
    for name in columns_of(Odometry):
        (a,), (b,) = small.result.parts(Odometry), once.result.parts(Odometry)
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name
    assert bytes_of(once.result)["odometry"] == bytes_of(small.result)["odometry"]


def test_the_plan_names_the_setting_where_it_stands(small: Mapped, here: Mapped, tmp_path: Path) -> None:
    cut = SMALL | {"odometry": {"windows": 3, "window_overlap_s": 1.0, "keyframe_m": 2.0}}
    request, _ = request_of(replace(order(tmp_path), command_line=cut))
    lines = {(t.node, t.coordinate.get("window")): t for t in plan(request, here.store)}
    assert lines["windows", None].verdict == "HIT"
    assert lines["track", "0001"].verdict == "RUN"
    assert lines["track", "0001"].reason == "settings.odometry.keyframe_m 1.0 -> 2.0"


def test_windows_are_set_with_odometry(tmp_path: Path) -> None:
    request, _ = request_of(replace(order(tmp_path), command_line=SMALL | {"track": {"windows": 3}}))
    with pytest.raises(UsageError, match="set those of `odometry`"):
        plan(request, Store(tmp_path / "store"))
