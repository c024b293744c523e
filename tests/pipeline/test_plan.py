"""Plans: what would run, and why."""

from __future__ import annotations

import dataclasses
import time

import pytest

from scanloom.pipeline.plan import PlannedTask, SessionInput, plan
from scanloom.pipeline.run import run
from scanloom.pipeline.store import explain
from scanloom.schemas.errors import UsageError
from tests.pipeline.reading import contents, verdicts
from tests.pipeline.toys.workflow import log, request

A = range(30)


def line(planned: list[PlannedTask], node: str) -> PlannedTask:
    return next(task for task in planned if task.node == node)


def test_on_an_empty_store_all_runs(tmp_path, store):
    planned = plan(request(log(tmp_path, "a", A)), store)
    assert {task.verdict for task in planned} == {"RUN"}
    assert [task.node for task in planned] == ["read", "smooth", "track", "join", "cut", "paint", "survey"]
    assert line(planned, "smooth").coordinate == {"session": "a", "chunk": "*"}
    assert line(planned, "paint").coordinate == {"tile": "*"}
    assert line(planned, "read").reason == "not computed yet"
    assert contents(store) == {}


def test_when_all_is_there_all_is_hit(tmp_path, store):
    asked = request(log(tmp_path, "a", A))
    result = run(asked, store, cluster="none")
    planned = plan(asked, store)
    assert [(t.node, t.coordinate, t.key) for t in planned] == [
        (t.node, t.coordinate, t.key) for t in result.tasks
    ]
    assert {task.verdict for task in planned} == {"HIT"}


def test_a_changed_setting_is_named(tmp_path, store):
    a = log(tmp_path, "a", A)
    run(request(a), store, cluster="none")
    planned = plan(request(a, settings={"cut": {"width": 7}}), store)
    assert verdicts(planned) == {
        "read": {"HIT": 1},
        "smooth": {"HIT": 3},
        "track": {"HIT": 1},
        "join": {"HIT": 1},
        "cut": {"RUN": 3},
        "paint": {"MAYBE": 1},
        "survey": {"MAYBE": 1},
    }
    assert line(planned, "cut").reason == "settings.cut.width 10 -> 7"
    assert line(planned, "paint").reason == "depends on what cut will give"


def test_structure_is_known_where_chunks_are(tmp_path, store):
    """Chunks are known although what is in them is not."""
    a = log(tmp_path, "a", A)
    run(request(a), store, cluster="none")
    planned = plan(request(a, settings={"smooth": {"step": 3}}), store)
    assert verdicts(planned)["smooth"] == {"RUN": 3}
    assert verdicts(planned)["track"] == {"MAYBE": 1}
    assert verdicts(planned)["cut"] == {"MAYBE": 3}
    assert line(planned, "cut").coordinate == {"session": "a", "chunk": "0000"}
    assert line(planned, "cut").reason == "depends on what smooth and join will give"


def test_a_task_whose_own_settings_are_new_surely_runs(tmp_path, store):
    a = log(tmp_path, "a", A)
    run(request(a), store, cluster="none")
    planned = plan(request(a, settings={"smooth": {"step": 3}, "cut": {"width": 7}}), store)
    assert {t.verdict for t in planned if t.node == "cut"} == {"RUN"}


def test_a_changed_log_is_a_changed_input(tmp_path, store):
    run(request(log(tmp_path, "a", A)), store, cluster="none")
    time.sleep(0.01)
    planned = plan(request(log(tmp_path, "a", range(29))), store)
    assert (line(planned, "read").verdict, line(planned, "read").reason) == ("RUN", "input log changed")
    assert {t.verdict for t in planned if t.node != "read"} == {"MAYBE"}


def test_going_back_is_a_hit(tmp_path, store):
    a = log(tmp_path, "a", A)
    run(request(a), store, cluster="none")
    run(request(a, settings={"cut": {"width": 7}}), store, cluster="none")
    assert {task.verdict for task in plan(request(a), store)} == {"HIT"}


def test_the_nearest_artifact_gives_the_reason(tmp_path, store):
    a = log(tmp_path, "a", A)
    for settings in ({}, {"cut": {"width": 7}}, {"cut": {"width": 9}, "smooth": {"step": 2}}):
        run(request(a, settings=settings), store, cluster="none")
    planned = plan(request(a, settings={"cut": {"width": 8}, "smooth": {"step": 2}}), store)
    assert line(planned, "cut").reason == "settings.cut.width 9 -> 8"


def test_an_unreadable_log_is_planned_to_fail(tmp_path, store):
    a = log(tmp_path, "a", A)
    (tmp_path / "a" / "log.txt").unlink()
    planned = plan(request(a), store)
    assert line(planned, "read").verdict == "FAIL"
    assert "log.txt" in line(planned, "read").reason


def test_one_session_cannot_set_a_stage_of_the_map(tmp_path, store):
    a = dataclasses.replace(log(tmp_path, "a", A), settings={"join": {"spacing": 1}})
    with pytest.raises(UsageError, match="session a: stage join runs for the whole map"):
        plan(request(a), store)


def test_session_names_stay_file_names(store):
    with pytest.raises(UsageError, match="must be letters"):
        plan(request(SessionInput("../x", {})), store)


# --- explain --------------------------------------------------------------------------------------------------------


def test_explain_tells_where_an_artifact_comes_from(tmp_path, store):
    a = log(tmp_path, "a", A)
    first = run(request(a), store, cluster="none")
    second = run(request(a, settings={"cut": {"width": 7}}), store, cluster="none")
    cuts = [t for t in second.tasks if t.node == "cut"]
    found = explain(store, cuts[1].key[:12])
    assert found.artifact.key == cuts[1].key
    assert found.coordinate == {"session": "a", "chunk": "0001"}
    assert found.settings["width"] == 7
    assert found.code["version"] == 1
    assert "tests.pipeline.toys.cut" in found.code["modules"]
    assert {i.product: i.made_by for i in found.inputs} == {
        "smooth": [f"smooth/{[t for t in first.tasks if t.node == 'smooth'][1].key}"],
        "shift": [f"join/{next(t for t in first.tasks if t.node == 'join').key}"],
    }
    assert found.before == [t for t in first.tasks if t.node == "cut"][1].key
    assert found.changes == ["settings.cut.width 10 -> 7"]


def test_explain_wants_one_artifact(tmp_path, store):
    run(request(log(tmp_path, "a", A)), store, cluster="none")
    with pytest.raises(UsageError, match="no artifact has a key"):
        explain(store, "zz")
    with pytest.raises(UsageError, match="artifacts have such a key"):
        explain(store, "")
    assert explain(store, "join/").artifact.stage == "join"
