"""Settings: layers, and errors that name what was meant."""

from __future__ import annotations

import dataclasses

import pytest
from pydantic import create_model

from scanloom.pipeline.fingerprint import digest
from scanloom.pipeline.flow import Flow, Task
from scanloom.pipeline.history import differences
from scanloom.pipeline.identity import Identifier
from scanloom.pipeline.node import node
from scanloom.pipeline.request import Request
from scanloom.pipeline.settings import resolve
from scanloom.schemas.errors import EXIT_USAGE, UsageError
from tests.pipeline.toys.cut import cut
from tests.pipeline.toys.products import Chunk, Info, Piece, Shift, Smooth
from tests.pipeline.toys.smooth import smooth
from tests.pipeline.toys.workflow import NODES, log


class Gentle(Smooth):
    NAME = "gentle"


def test_defaults_then_layers():
    layers = [
        ("project.yaml", {"smooth": {"step": 2, "refuse": 8}, "cut": {"width": 4}}),
        ("command line", {"smooth": {"step": "3"}}),
    ]
    settings = resolve(NODES, layers)
    assert settings["smooth"].model_dump() == {"step": 3, "pause_s": 0.0, "refuse": 8}
    assert settings["cut"].width == 4
    assert settings["read"].chunk_items == 2


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ({"smoth": {"step": 2}}, "project.yaml: 'smoth' is no stage Next: did you mean `smooth`?"),
        ({"smooth": {"stepp": 2}}, "'stepp' is no setting of stage smooth Next: did you mean `step`?"),
        ({"smooth": {"xyzzy": 2}}, "known are step, pause_s, refuse"),
        ({"smooth": 5}, "settings of stage smooth must be fields and values, not 5"),
        (
            {"smooth": {"step": 0}},
            "project.yaml: settings.smooth.step = 0: input should be greater than or equal to 1 "
            "Next: it means: numbers become multiples of it; the default is 1",
        ),
        ({"smooth": {"step": "much"}}, "settings.smooth.step = 'much': input should be a valid integer"),
    ],
)
def test_what_is_wrong_is_named(layer, message):
    with pytest.raises(UsageError) as caught:
        resolve(NODES, [("project.yaml", layer), ("command line", {"cut": {"width": 3}})])
    assert message in str(caught.value)
    assert caught.value.exit_code == EXIT_USAGE


def test_the_layer_at_fault_is_the_last_that_sets_the_field():
    with pytest.raises(UsageError, match=r"command line: settings\.smooth\.step = 99"):
        resolve(
            NODES, [("project.yaml", {"smooth": {"step": 2}}), ("command line", {"smooth": {"step": 99}})]
        )


# --- settings of another stage ----------------------------------------------------------------------------------------

SHARING = (*NODES, node("gentle", smooth, per="chunk", reads=(Chunk, Info), writes=Gentle, settings="smooth"))


def test_a_stage_may_use_the_settings_of_another():
    settings = resolve(SHARING, [("command line", {"smooth": {"step": 4}})])
    assert settings["gentle"] == settings["smooth"]
    assert settings["gentle"].step == 4


def test_shared_settings_are_set_where_they_stand():
    with pytest.raises(UsageError, match="'gentle' has no settings of its own Next: set those of `smooth`"):
        resolve(SHARING, [("command line", {"gentle": {"step": 4}})])


def test_a_stage_sees_only_what_its_own_model_has():
    pace = create_model("Settings", pause_s=(float, 0.5))
    hasty = dataclasses.replace(SHARING[-1], settings=pace)
    settings = resolve((*NODES, hasty), [("command line", {"smooth": {"step": 4, "pause_s": 1}})])
    assert settings["gentle"] == pace(pause_s=1)
    assert resolve((*NODES, hasty), [])["gentle"] == pace(pause_s=0)


def test_what_a_stage_uses_of_another_is_there():
    wrong = node("other", cut, per="chunk", reads=(Smooth, Shift), writes=Piece, settings="smooth")
    with pytest.raises(UsageError, match="node other needs width, which smooth cannot be told"):
        resolve((*NODES, wrong), [])
    with pytest.raises(UsageError, match="node gentle uses the settings of smooth, which has none"):
        resolve(SHARING[-1:], [])


def test_shared_settings_are_part_of_the_key_and_named_in_the_reason(tmp_path, store):
    a = log(tmp_path, "a", range(30))
    first = Flow(Request(SHARING[:3] + SHARING[-1:], (a,)))
    second = Flow(Request(SHARING[:3] + SHARING[-1:], (a,), {"smooth": {"step": 4}}))
    old, new = (
        Identifier(flow, store).constant(Task(SHARING[-1], (), flow.settings(SHARING[-1], "a")))
        for flow in (first, second)
    )
    assert new["settings"]["step"] == 4
    assert digest(old) != digest(new)
    assert differences(old, new) == ["settings.smooth.step 1 -> 4"]


def test_one_session_cannot_set_what_a_stage_of_the_map_shares(tmp_path):
    a = dataclasses.replace(log(tmp_path, "a", range(30)), settings={"smooth": {"step": 2}})
    of_the_map = node("whole", smooth, per="map", reads=(Chunk, Info), writes=Gentle, settings="smooth")
    with pytest.raises(UsageError, match="stage smooth runs for the whole map"):
        Flow(Request((*NODES, of_the_map), (a,)))
