"""Templates beside this module, with everything escaped that is not marked as safe."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from scanloom.stages.report.figures import number
from scanloom.stages.report.overlay import SESSION_COLOURS

FOLDER = Path(__file__).parent
LAYER_WORDS = {"height": "height", "intensity": "intensity", "classes": "class", "colour": "colour"}
"""What the pictures of the map are called."""


@lru_cache(maxsize=1)
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["number"] = number
    environment.globals["session_colours"] = SESSION_COLOURS
    environment.globals["layer_words"] = LAYER_WORDS
    return environment


def render(name: str, **values: Any) -> str:
    """The template `name` filled in."""
    return _environment().get_template(name).render(**values)


def style() -> str:
    """The style sheet of all pages."""
    return asset("style.css")


@lru_cache(maxsize=8)
def asset(name: str) -> str:
    """A file of the page as it is. No carriage returns may be in it: a browser would change them and its digest."""
    return (FOLDER / name).read_text(encoding="utf-8")
