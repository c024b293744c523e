"""Figures of a benchmark, as JSON and as lines on the screen."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.scores import Figure


def written(figures: Sequence[Figure], to: str | Path) -> None:
    """The finite ones as JSON: on standard output for `-`, else into a file, nowhere for an empty name."""
    text = json.dumps([figure.row() for figure in figures if np.isfinite(figure.value)], indent=1)
    if to == "-":
        print(text)
    elif to:
        Path(to).write_text(text + "\n")


def published(figures: Sequence[Figure], to: str) -> None:
    """`written`, and as lines unless the screen has them as JSON."""
    written(figures, to)
    if to == "-":
        return
    for figure in figures:
        Console(width=200).print(f"{figure.name:52} {figure.value:12.5g} {figure.unit:4} {figure.method}")
