"""Whole pages, each one self-contained file: the report of a map, and the summary of a night."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from scanloom.schemas.metrics import kind_of
from scanloom.stages.report.templates import asset, render, style


def compose(body_html: str, run_section: str, title: str) -> str:
    """The report as one file: the stage's body, then what varies from run to run, and the scripts that draw its plots.

    The page forbids itself to load anything and to run any other script, whatever the names in a log look like.
    """
    library, script = asset("vendor/plotly-basic.min.js"), asset("page.js")
    hashes = " ".join(f"'sha256-{_sha256(text)}'" for text in (library, script))
    policy = f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {hashes}"
    return render(
        "page.html", title=title, style=style(), body=body_html, run_section=run_section,
        library=library, script=script, policy=policy,
    )  # fmt: skip


def _sha256(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


FLEET_COLUMNS = (
    ("fusion.ate_rmse_m", "ATE, m"),
    ("odometry.kitti_t_rel_percent", "t_rel, %"),
    ("odometry.unreliable_scans", "bridged scans"),
    ("loops.accepted", "loops"),
    ("map.mme_r0.5_nat", "MME, nat"),
    ("map.points", "points"),
    ("run.realtime_factor", "real-time"),
)


def fleet_page(rows: Sequence[Mapping[str, Any]], made: str, title: str = "Nightly maps") -> str:
    """The summary of a night, one line per map and session.

    rows : per map `map`, `sessions`, `delivered`, `report` (link or None), `new`, `warnings`, `failures` and `metrics`,
    each metric with `name`, `value`, `unit`, `session` where it has one, and `previous` (None on the first night).
    """
    maps = [{**row, "lines": _lines(row)} for row in rows]
    counts = {
        "maps": len(rows),
        "delivered": sum(bool(row["delivered"]) for row in rows),
        "sessions": sum(len(row["sessions"]) for row in rows),
        "failed": sum(bool(row["failures"]) for row in rows),
    }
    columns = [label for _, label in FLEET_COLUMNS]
    return render(
        "fleet.html", title=title, style=style(), made=made, maps=maps, counts=counts, columns=columns
    )


def _lines(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A line per session that has metrics; figures of the whole map stand on the first."""
    by_session: dict[str, dict[str, Mapping[str, Any]]] = {}
    for metric in row["metrics"]:
        by_session.setdefault(metric.get("session") or "", {})[metric["name"]] = metric
    whole = by_session.pop("", {})
    names = list(by_session) or [", ".join(row["sessions"])]
    return [
        {"session": name, "cells": [_cell({**(whole if i == 0 else {}), **by_session.get(name, {})}, column)
                                    for column, _ in FLEET_COLUMNS]}
        for i, name in enumerate(names)
    ]  # fmt: skip


def _cell(metrics: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, Any]:
    metric = metrics.get(name)
    if metric is None:
        return {"value": None, "change": None, "trend": ""}
    previous = metric.get("previous")
    change = None if previous is None else metric["value"] - previous
    return {"value": metric["value"], "change": change or None, "trend": _trend(name, change, previous)}


def _trend(name: str, change: float | None, previous: float | None) -> str:
    """`better`, `worse`, or nothing for changes under one per cent."""
    kind = kind_of(name)
    if not change or previous is None or kind is None or not kind.better:
        return ""
    if abs(change) < 0.01 * abs(previous):
        return ""
    return "better" if kind.badness(previous + change) < kind.badness(previous) else "worse"
