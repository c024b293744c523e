"""Metrics by name, and how a figure is written."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scanloom.schemas.evaluation import Metrics

THIN_SPACE = "\u2009"


@dataclass(frozen=True)
class Row:
    """One metric, ready to print."""

    name: str
    value: float
    unit: str
    method: str
    truth: bool = False
    """Whether truth was needed."""

    @property
    def text(self) -> str:
        return number(self.value)


@dataclass(frozen=True)
class Pair:
    """The same metric of odometry and of the map's poses."""

    name: str
    odometry: Row | None
    fusion: Row | None

    @property
    def any(self) -> Row:
        """The one that is there: unit and method are the same."""
        row = self.odometry or self.fusion
        if row is None:
            raise ValueError(f"{self.name} has neither value")
        return row


class Figures:
    """The metrics of a map and its sessions."""

    def __init__(self, metrics: Metrics) -> None:
        self._rows: dict[str, list[Row]] = {}
        for i in range(len(metrics)):
            value, truth = float(metrics.value[i]), bool(metrics.truth[i])
            row = Row(metrics.name[i], value, metrics.unit[i], metrics.method[i], truth)
            self._rows.setdefault(metrics.session[i], []).append(row)

    def rows(self, session: str = "") -> list[Row]:
        """Metrics of a session, or of the map."""
        return self._rows.get(session, [])

    def pairs(self, session: str) -> list[Pair]:
        """Metrics that exist as `odometry.NAME` and `fusion.NAME`, at least one of them, for the others see `single`."""
        rows = {row.name: row for row in self.rows(session)}
        both = {name.partition(".")[2] for name in rows if name.startswith("fusion.")}
        names = [name.partition(".")[2] for name in rows if name.partition(".")[0] in ("odometry", "fusion")]
        ordered = [name for name in dict.fromkeys(names) if name in both]
        return [Pair(name, rows.get(f"odometry.{name}"), rows.get(f"fusion.{name}")) for name in ordered]

    def single(self, session: str = "") -> list[Row]:
        """Metrics of a session or of the map that `pairs` does not show."""
        paired = {pair.name for pair in self.pairs(session)} if session else set()
        return [row for row in self.rows(session) if row.name.partition(".")[2] not in paired]

    def get(self, name: str, session: str = "") -> float | None:
        """One figure; None when it was not computed."""
        return next((row.value for row in self.rows(session) if row.name == name), None)


def number(value: float) -> str:
    """Four significant digits, thousands separated by a thin space; integers in full."""
    if not math.isfinite(value):
        return "–"
    if abs(value) < 1e-6:
        return "0"
    if value == round(value) and abs(value) < 1e15:
        return f"{round(value):,}".replace(",", THIN_SPACE)
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", THIN_SPACE)
    return f"{value:.4g}"
