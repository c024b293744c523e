"""The engine on the toy workflow: fan-out, reuse, failures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from scanloom.pipeline.cluster import InProcess
from scanloom.pipeline.plan import Request, SessionInput
from scanloom.pipeline.run import run
from scanloom.schemas.errors import EXIT_INVALID_INPUT, InvalidInput, ScanloomError, StageError, UsageError
from tests.pipeline.reading import contents, leftovers, record, verdicts
from tests.pipeline.toys import join as join_module
from tests.pipeline.toys import smooth as smooth_module
from tests.pipeline.toys.products import Log, Overview, Piece, Shift, Smooth, Summary, Tile, TileText, Track
from tests.pipeline.toys.workflow import log, request

A = range(30)
B = range(10, 35)


def two(tmp_path, **settings) -> Request:
    return request(log(tmp_path, "a", A), log(tmp_path, "b", B), settings=settings)


def test_fans_out_over_sessions_chunks_and_tiles(tmp_path, store):
    result = run(two(tmp_path, join={"spacing": 100}), store, cluster="none")
    counts = {name: sum(c.values()) for name, c in verdicts(result).items()}
    assert counts == {"read": 2, "smooth": 6, "track": 2, "join": 1, "cut": 6, "paint": 6, "survey": 1}
    assert result.executed == 24
    assert not result.failures

    tracks = dict(zip(["a", "b"], result.parts(Track)))
    assert tracks["a"].total.tolist() == np.arange(30).reshape(-1, 5).sum(axis=1).tolist()
    (summary,) = result.parts(Summary)
    assert summary.sessions == ("a", "b")
    assert summary.total == sum(A) + sum(B)

    (overview,) = result.parts(Overview)
    assert overview.tiles == ("0_0", "11_0", "12_0", "13_0", "1_0", "2_0")
    assert overview.count == 55
    tiles = {place["tile"]: tile for place, tile in result.parts(Tile).items()}
    assert tiles["0_0"].value.tolist() == list(range(10))
    assert list(tiles["1_0"].origins) == ["a/0001"]
    assert tiles["11_0"].value.tolist() == list(range(110, 120))


def test_parts_stand_where_they_belong(tmp_path, store):
    result = run(two(tmp_path), store, cluster="none")
    assert [dict(c) for c, _ in result.files(Shift)] == [{"session": "a"}, {"session": "b"}]
    first, path = result.files(Piece)[0]
    assert dict(first) == {"session": "a", "chunk": "0000", "tile": "0_0"}
    assert path.name == "0_0.parquet"
    assert path.parent.name == "piece"
    place, folder = result.files(TileText)[1]
    assert dict(place) == {"tile": "1_0"}
    assert folder.is_dir()
    assert (folder / "tile.txt").read_text().startswith("[10, 10, 11")


def test_parts_open_when_asked(tmp_path, store):
    result = run(two(tmp_path), store, cluster="none")
    parts = result.parts(Smooth)
    assert len(parts) == 6
    assert [item.index for chunk in parts.by("session")["a"] for item in chunk] == list(range(6))
    assert len(parts[0].index) == 2
    assert parts[0][1].value.tolist() == [5, 6, 7, 8, 9]


def test_second_run_computes_nothing(tmp_path, store):
    first = run(two(tmp_path), store, cluster="none")
    before = contents(store)
    again = run(two(tmp_path), store, cluster="none")
    assert again.executed == 0
    assert {t.verdict for t in again.tasks} == {"HIT"}
    assert [t.key for t in again.tasks] == [t.key for t in first.tasks]
    assert contents(store) == before
    assert again.files(Tile) == first.files(Tile)


def test_no_cluster_is_started_when_all_is_there(tmp_path, store):
    run(two(tmp_path), store, cluster="none")
    assert run(two(tmp_path), store, cluster="no:such_cluster").executed == 0


def test_a_setting_reruns_only_what_it_touches(tmp_path, store):
    run(two(tmp_path), store, cluster="none")
    result = run(two(tmp_path, cut={"width": 7}), store, cluster="none")
    ran = {name for name, count in verdicts(result).items() if count["RUN"]}
    assert ran == {"cut", "paint", "survey"}
    assert record(result, "cut", session="a", chunk="0000").reason == "settings.cut.width 10 -> 7"


def test_same_bytes_stop_a_change(tmp_path, store):
    """Waiting longer changes the key of `smooth` but not its bytes, so nothing after it runs."""
    run(two(tmp_path), store, cluster="none")
    result = run(two(tmp_path, smooth={"pause_s": 0.001}), store, cluster="none")
    assert {name: dict(c) for name, c in verdicts(result).items() if c["RUN"]} == {"smooth": {"RUN": 6}}


def test_a_session_may_have_its_own_settings(tmp_path, store):
    a, b = log(tmp_path, "a", A), log(tmp_path, "b", B)
    run(request(a, b), store, cluster="none")
    own = dataclasses.replace(b, settings={"smooth": {"step": 5}})
    result = run(request(a, own), store, cluster="none")
    assert {t.coordinate["session"] for t in result.tasks if t.node == "smooth" and t.verdict == "RUN"} == {
        "b"
    }
    changed = record(result, "track", session="b")
    assert (changed.verdict, changed.reason) == ("RUN", "input smooth changed")


def test_a_new_session_leaves_the_old_ones_alone(tmp_path, store):
    a, b = log(tmp_path, "a", A), log(tmp_path, "b", B)
    run(request(a), store, cluster="none")
    result = run(request(a, b), store, cluster="none")
    assert {
        t.node for t in result.tasks if t.verdict == "RUN" and t.coordinate.get("session") == "a"
    } == set()
    assert record(result, "join").reason == "input info changed; input track changed"


def test_the_name_of_a_session_is_no_part_of_what_does_not_see_it(tmp_path, store):
    run(request(log(tmp_path, "a", A)), store, cluster="none")
    result = run(request(log(tmp_path, "other", A)), store, cluster="none")
    assert record(result, "read", session="other").verdict == "HIT"
    assert record(result, "smooth", session="other", chunk="0001").verdict == "HIT"
    assert record(result, "track", session="other").verdict == "RUN"


def test_the_same_log_twice_is_read_once(tmp_path, store):
    result = run(request(log(tmp_path, "a", A), log(tmp_path, "b", A)), store, cluster="none")
    assert verdicts(result)["read"] == {"RUN": 1, "HIT": 1}
    assert len(result.parts(Track)) == 2


def test_simulated_sessions_make_their_own_log(tmp_path, store):
    made = SessionInput("c", {}, tags=frozenset({"simulated"}), settings={"make": {"seed": 3}})
    result = run(request(log(tmp_path, "a", A), made), store, cluster="none")
    assert [t.coordinate for t in result.tasks if t.node == "make"] == [{"session": "c"}]
    assert len(result.parts(Track)) == 2


def test_sessions_without_their_files_are_refused(tmp_path, store):
    with pytest.raises(UsageError, match="session c brings no log, which read reads"):
        run(request(SessionInput("c", {})), store, cluster="none")
    with pytest.raises(UsageError, match="no session is given"):
        run(request(), store, cluster="none")
    with pytest.raises(UsageError, match="session name a is used twice"):
        run(request(log(tmp_path, "a", A), log(tmp_path, "a", A)), store, cluster="none")


# --- failures -------------------------------------------------------------------------------------------------------


def test_one_bad_session_does_not_stop_the_others(tmp_path, store):
    sessions = [log(tmp_path, "a", A), log(tmp_path, "bad", A, "broken"), log(tmp_path, "b", B)]
    result = run(request(*sessions), store, cluster="none")
    (failed,) = result.failures
    assert (failed.node, failed.coordinate) == ("read", {"session": "bad"})
    assert isinstance(failed.error, InvalidInput)
    assert failed.error.exit_code == EXIT_INVALID_INPUT
    assert "the log is broken" in str(failed.error)
    assert [t.node for t in result.skipped] == ["track"]
    (summary,) = result.parts(Summary)
    assert summary.sessions == ("a", "b")

    alone = run(request(sessions[0], sessions[2]), store, cluster="none")
    assert alone.executed == 0
    assert store.status().failures == [("read-session-bad", str(failed.error))]


def test_a_failed_chunk_takes_its_whole_session_out(tmp_path, store):
    a, b = log(tmp_path, "a", A), log(tmp_path, "b", B)
    result = run(request(a, b, settings={"smooth": {"refuse": 7}}), store, cluster="none")
    (failed,) = result.failures
    assert failed.coordinate == {"session": "a", "chunk": "0000"}
    assert isinstance(failed.error, StageError)
    assert failed.error.where == "smooth session=a chunk=0000: item 1"
    assert {(t.node, t.reason) for t in result.skipped} == {
        ("track", "smooth session=a chunk=0000 failed"),
        ("cut", "smooth session=a chunk=0000 failed"),
        ("cut", "session a was left out before"),
    }
    assert result.parts(Summary)[0].sessions == ("b",)
    assert all(origin.startswith("b/") for tile in result.parts(Tile) for origin in tile.origins)


def test_a_session_lost_late_leaves_the_tiles_too(tmp_path, store):
    """Its pose was used and some of its pieces exist; tiles hold the other session only, in whatever order tasks ran."""
    a, b = log(tmp_path, "a", A), log(tmp_path, "b", B)
    a = dataclasses.replace(a, settings={"cut": {"refuse": 29}})
    result = run(request(a, b), store, cluster="none")
    assert [t.coordinate for t in result.failures] == [{"session": "a", "chunk": "0002"}]
    assert result.parts(Summary)[0].sessions == ("a", "b")
    assert [place["tile"] for place, _ in result.parts(Tile).items()] == ["1_0", "2_0", "3_0"]
    assert all(origin.startswith("b/") for tile in result.parts(Tile) for origin in tile.origins)


def test_a_failed_map_task_skips_what_follows(tmp_path, store, monkeypatch):
    def join(settings, tracks, infos):
        raise StageError("no join today")

    monkeypatch.setattr(join_module, "join", join)
    result = run(two(tmp_path), store, cluster="none")
    assert verdicts(result)["cut"] == {"SKIPPED": 6}
    assert record(result, "cut", session="a", chunk="0000").reason == "join failed"
    assert verdicts(result)["survey"] == {"SKIPPED": 1}


def test_when_no_session_is_left_the_map_is_skipped(tmp_path, store):
    result = run(request(log(tmp_path, "bad", A, "broken")), store, cluster="none")
    assert verdicts(result) == {
        "read": {"FAILED": 1},
        "track": {"SKIPPED": 1},
        "join": {"SKIPPED": 1},
        "survey": {"SKIPPED": 1},
    }
    assert record(result, "join").reason == "no session is left"


def test_an_unexpected_error_is_wrapped_and_its_traceback_kept(tmp_path, store):
    result = run(request(log(tmp_path, "a", A, "odd")), store, cluster="none")
    error = result.failures[0].error
    assert type(error) is ScanloomError
    assert str(error).startswith("read session=a: KeyError: 'odd thing'")
    (kept,) = (store.root / "failures").iterdir()
    assert str(kept) in error.next_step
    assert "Traceback" in kept.read_text()


def test_a_failure_is_forgotten_when_it_is_made_good(tmp_path, store):
    run(request(log(tmp_path, "a", A, "broken")), store, cluster="none")
    assert len(store.status().failures) == 1
    run(request(log(tmp_path, "a", A)), store, cluster="none")
    assert store.status().failures == []


def test_a_missing_log_fails_its_session(tmp_path, store):
    a, b = log(tmp_path, "a", A), log(tmp_path, "b", B)
    (tmp_path / "a" / "log.txt").unlink()
    result = run(request(a, b), store, cluster="none")
    assert isinstance(result.failures[0].error, InvalidInput)
    assert "log.txt" in str(result.failures[0].error)
    assert result.parts(Summary)[0].sessions == ("b",)


def test_a_log_without_a_folder_fails_its_session(tmp_path, store):
    bad = SessionInput("bad", {Log: Log(names=("log.txt",))})
    result = run(request(log(tmp_path, "a", A), bad), store, cluster="none")
    (failed,) = result.failures
    assert (failed.node, failed.coordinate) == ("read", {"session": "bad"})
    assert isinstance(failed.error, InvalidInput)
    assert "source files have no folder" in str(failed.error)
    assert result.parts(Summary)[0].sessions == ("a",)


def test_a_source_without_a_folder_that_nobody_reads_does_no_harm(tmp_path, store):
    a = log(tmp_path, "a", A)
    more = dataclasses.replace(a, sources={**a.sources, TileText: TileText(names=("tile.txt",))})
    result = run(request(more), store, cluster="none")
    assert not result.failures
    assert result.parts(Summary)[0].sessions == ("a",)


def test_a_log_that_is_still_being_written_fails_its_session(tmp_path, store):
    result = run(request(log(tmp_path, "a", A, "growing"), log(tmp_path, "b", B)), store, cluster="none")
    assert isinstance(result.failures[0].error, InvalidInput)
    assert "log.txt: the file changed while it was read" in str(result.failures[0].error)
    assert store.find("read", result.failures[0].key) is None
    assert result.parts(Summary)[0].sessions == ("b",)


def test_nothing_half_written_stays(tmp_path, store):
    run(request(log(tmp_path, "a", A), settings={"smooth": {"refuse": 29}}), store, cluster="none")
    assert leftovers(store) == []


# --- what a stage may return -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda: 3, "returned int, not products"),
        (lambda: [3], "returned int, which its node does not declare"),
        (lambda: (), "did not return smooth"),
    ],
)
def test_a_stage_must_return_what_it_declares(tmp_path, store, monkeypatch, returned, message):
    monkeypatch.setattr(smooth_module, "smooth", lambda *_: returned())
    result = run(request(log(tmp_path, "a", A)), store, cluster="none")
    assert message in str(result.failures[0].error)


def test_code_that_differs_from_the_key_is_refused(tmp_path, store, monkeypatch):
    """A worker with another version of the code must not publish under this key."""
    from scanloom.pipeline import task

    monkeypatch.setattr(task, "code_here", lambda names: dict.fromkeys(names, "other"))
    result = run(request(log(tmp_path, "a", A)), store, cluster="none")
    assert "this worker has another version" in str(result.failures[0].error)


def test_of_equal_tasks_the_biggest_goes_first(tmp_path, store, monkeypatch):
    """Tiles differ in size, and a big one at the end would leave the other workers idle."""
    given: list[tuple[str, int]] = []
    submit = InProcess.submit

    def noting(self, key, spec, resources):
        read = sum(p.stat().st_size for e in spec["reads"] for p in map(_path, e["parts"]) if p.is_file())
        given.append((spec["identity"]["stage"], read))
        submit(self, key, spec, resources)

    monkeypatch.setattr(InProcess, "submit", noting)
    run(request(log(tmp_path, "a", [*range(10), *range(20, 30), *range(20, 30)])), store, cluster="none")
    sizes = [size for stage, size in given if stage == "paint"]
    assert len(set(sizes)) > 1
    assert sizes == sorted(sizes, reverse=True)


def _path(part) -> Path:
    return Path(part["path"])
