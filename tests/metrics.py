"""Tables of metrics from their names and values."""

from __future__ import annotations

from collections.abc import Sequence

from scanloom.schemas.evaluation import Metrics
from scanloom.stages.evaluation.figures import Figure, to_metrics


def metrics_table(rows: Sequence[tuple[str, float, str]]) -> Metrics:
    """Of (name, value, session); those of the map have no session."""
    return to_metrics(
        Figure(name, value, "", "", "session" if session else "map", session) for name, value, session in rows
    )
