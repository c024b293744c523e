"""Settings: layers, and errors that name what was meant."""

from __future__ import annotations

import pytest

from scanloom.pipeline.settings import resolve
from scanloom.schemas.errors import EXIT_USAGE, UsageError
from tests.pipeline.toys.workflow import NODES


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
