"""The gate of a night: is a map worse than it was last night, by more than noise?"""

from __future__ import annotations

from pathlib import Path

from scanloom.schemas.errors import ScanloomError
from scanloom.workflows.compare_maps import Side, judged_sessions, read_side
from scanloom.workflows.metric_changes import Change, metric_changes, regressions
from scanloom.workflows.noise import Noise


def as_it_was(folder: Path) -> Side | None:
    """The map in a folder before it is made anew; None when there is none that can be read."""
    try:
        return read_side(folder)
    except ScanloomError:
        return None


def worse_than(before: Side | None, folder: Path, noise: Noise | None) -> list[str]:
    """A sentence for every metric of the map that is worse than before, as far as both were made of the same logs."""
    after = as_it_was(folder)
    if before is None or after is None:
        return []
    judged, _ = judged_sessions(before, after)
    found = regressions(metric_changes(before.metrics, after.metrics, noise, judged))
    return [_sentence(change) for change in found]


def _sentence(change: Change) -> str:
    unit = f" {change.unit}" if change.unit else ""
    return (
        f"regression: {change.label} went from {change.before:.4g} to {change.after:.4g}{unit}; "
        f"{change.allowed:.2g} are allowed ({'measured noise' if change.source == 'noise' else 'default'})"
    )
