"""The page of two maps side by side, one self-contained file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scanloom.stages.report.templates import render, style


def comparison_page(found: Mapping[str, Any], title: str) -> str:
    """What `scanloom compare --json` gives, as a page; what came out of noise stands first."""
    rows = found["metrics"]
    judged = sum(row["allowed"] is not None for row in rows)
    if found["regressions"]:
        word, tone = "Worse", "fail"
    elif judged:
        word, tone = "No worse", "pass"
    else:
        word, tone = "Not judged", "warn"
    moved = [row for row in rows if row["verdict"] in ("regression", "better")]
    moved.sort(key=lambda row: row["verdict"] != "regression")
    rest = [row for row in rows if row["verdict"] not in ("regression", "better")]
    groups = [
        {"title": "Worse or better by more than is allowed", "rows": moved},
        {"title": "Without truth", "rows": [row for row in rest if not row["truth"]]},
        {"title": "Against truth", "rows": [row for row in rest if row["truth"]]},
    ]
    return render(
        "comparison.html", title=title, style=style(), found=found, groups=groups, word=word, tone=tone, judged=judged
    )  # fmt: skip
