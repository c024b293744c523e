"""Where the figures of a benchmark go."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.figures import published, written
from benchmarks.scores import Figure

FIGURES = [Figure("a.b", 1.5, "m", "session", "how"), Figure("a.c", np.nan, "", "session", "unknown")]


def test_what_is_finite_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written(FIGURES, tmp_path / "figures.json")
    rows = json.loads((tmp_path / "figures.json").read_text())
    assert [row["name"] for row in rows] == ["a.b"]
    assert rows[0]["value"] == 1.5
    written(FIGURES, "-")
    assert json.loads(capsys.readouterr().out) == rows
    written(FIGURES, "")
    assert capsys.readouterr().out == ""


def test_lines_are_for_those_who_do_not_ask_for_json(capsys: pytest.CaptureFixture[str]) -> None:
    published(FIGURES, "")
    assert "a.c" in capsys.readouterr().out
    published(FIGURES, "-")
    assert len(json.loads(capsys.readouterr().out)) == 1
