"""Templates beside this module, with everything escaped that is not marked as safe."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from scanloom.stages.report.figures import number
from scanloom.stages.report.overlay import SESSION_COLOURS

FOLDER = Path(__file__).parent


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
    return environment


def render(name: str, **values: Any) -> str:
    """The template `name` filled in."""
    return _environment().get_template(name).render(**values)


def style() -> str:
    """The style sheet of all pages."""
    return (FOLDER / "style.css").read_text()
