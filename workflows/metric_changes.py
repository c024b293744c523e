"""Metrics of two maps side by side: which changed, for better or worse, and by more than noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from scanloom.schemas.metrics import MetricKind, kind_of
from scanloom.workflows.noise import Noise

Row = Mapping[str, Any]
"""A row of `metrics.json`."""
Verdict = Literal["regression", "better", "same", "changed", "only in A", "only in B"]
"""`changed`: neither way is known to be better, or the metric is not judged."""
Source = Literal["noise", "default", ""]


@dataclass(frozen=True)
class Change:
    """One metric in both maps."""

    name: str
    session: str
    unit: str
    before: float | None
    after: float | None
    better: str
    """Which way is better, empty when that is not known."""
    allowed: float | None
    """How much worse is no regression, in the metric's unit; None when it is not judged."""
    source: Source
    """Where `allowed` comes from."""
    truth: bool
    verdict: Verdict

    @property
    def label(self) -> str:
        """Name, and the session where there is one."""
        return f"{self.name} [{self.session}]" if self.session else self.name

    def as_json(self) -> dict[str, Any]:
        return dict(vars(self))


def metric_changes(
    before: Iterable[Row], after: Iterable[Row], noise: Noise | None, judged: frozenset[str] | None = None
) -> list[Change]:
    """Every metric of either map, in the order of their rows.

    judged : sessions whose metrics may be judged, "" for those of the whole map; None judges all.
    """
    a, b = by_key(before), by_key(after)
    return [_change(key, a.get(key), b.get(key), noise, judged) for key in {**a, **b}]


def by_key(rows: Iterable[Row]) -> dict[tuple[str, str], Row]:
    """Rows by name and session; of a map of one session the session has no name."""
    return {(str(row["name"]), str(row.get("session", ""))): row for row in rows}


def regressions(changes: Iterable[Change]) -> list[Change]:
    return [change for change in changes if change.verdict == "regression"]


def _change(
    key: tuple[str, str], a: Row | None, b: Row | None, noise: Noise | None, judged: frozenset[str] | None
) -> Change:
    name, session = key
    row: Row = a or b or {}
    kind = kind_of(name)
    before, after = _value(a, kind), _value(b, kind)
    allowed, source = _allowed(kind, key, before, noise)
    scope = "" if row.get("scope") in ("map", "run") else session or "*"
    if judged is not None and scope not in judged:
        allowed, source = None, ""
    return Change(
        name, session, str(row.get("unit", "")), before, after, kind.better if kind else "", allowed, source,
        bool(row.get("truth", kind is not None and kind.truth)), _verdict(kind, before, after, allowed),
    )  # fmt: skip


def _value(row: Row | None, kind: MetricKind | None) -> float | None:
    if row is None:
        return kind.absent if kind else None
    return float(row["value"])


def _allowed(
    kind: MetricKind | None, key: tuple[str, str], before: float | None, noise: Noise | None
) -> tuple[float | None, Source]:
    if kind is None or not kind.better or before is None:
        return None, ""
    measured = None if noise is None else noise.tolerance(key)
    if measured is not None:
        return measured, "noise"
    return (None, "") if kind.varies else (kind.tolerance(before), "default")


def _verdict(
    kind: MetricKind | None, before: float | None, after: float | None, allowed: float | None
) -> Verdict:
    if before is None or after is None:
        return "only in B" if before is None else "only in A"
    if kind is None or allowed is None:
        return "same" if before == after else "changed"
    worse = kind.badness(after) - kind.badness(before)
    slack = 1e-9 * max(abs(before), abs(after))  # a change of just what is allowed is allowed
    if worse > allowed + slack:
        return "regression"
    return "better" if -worse > allowed + slack else "same"
