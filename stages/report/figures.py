"""Metrics by name, and how a figure is written."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scanloom.schemas.evaluation import Metrics


@dataclass(frozen=True)
class Row:
    """One metric, ready to print."""

    name: str
    value: float
    unit: str
    method: str

    @property
    def text(self) -> str:
        return number(self.value)


class Figures:
    """The metrics of a map and its sessions."""

    def __init__(self, metrics: Metrics) -> None:
        self._rows: dict[str, list[Row]] = {}
        for i in range(len(metrics)):
            row = Row(metrics.name[i], float(metrics.value[i]), metrics.unit[i], metrics.method[i])
            self._rows.setdefault(metrics.session[i], []).append(row)

    def rows(self, session: str = "") -> list[Row]:
        """Metrics of a session, or of the map."""
        return self._rows.get(session, [])

    def get(self, name: str, session: str = "") -> float | None:
        """One figure; None when it was not computed."""
        return next((row.value for row in self.rows(session) if row.name == name), None)


def number(value: float) -> str:
    """Four significant digits, thousands separated by a thin space; integers in full."""
    if not math.isfinite(value):
        return "–"
    if value == round(value) and abs(value) < 1e15:
        return f"{round(value):,}".replace(",", " ")
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.4g}"
