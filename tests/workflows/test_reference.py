"""The documents say what the code does."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanloom.workflows.map_session import NODES
from scanloom.workflows.reference import pages

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", sorted(pages()))
def test_page_is_up_to_date(name: str) -> None:
    assert (DOCS / name).read_text() == pages()[name], "run `make docs`"


@pytest.mark.parametrize("node", NODES, ids=lambda n: n.name)
def test_every_setting_says_what_it_means(node) -> None:
    for name, field in node.settings.model_fields.items():
        assert field.description, f"{node.name}.{name} has no description"
        numeric = field.annotation in (int, float)
        assert not numeric or field.metadata, f"{node.name}.{name} has no bounds"
    assert node.settings.model_config.get("frozen") and node.settings.model_config.get("extra") == "forbid"
