"""The verdict as one sentence."""

from __future__ import annotations

from scanloom.stages.report.verdict import Level, Verdict

_OPENINGS: dict[Level, str] = {
    "fail": "Do not rely on this map as it is",
    "warn": "This map is usable with care",
    "note": "This map can be relied on",
    "pass": "This map can be relied on",
}


def sentence(verdict: Verdict) -> str:
    """How far to trust the map, with the worst that was found, or how many checks it passed."""
    opening = _OPENINGS[verdict.level]
    passed = sum(check.level == "pass" for check in verdict.checks)
    if verdict.level not in ("fail", "warn"):
        return (
            f"{opening}: nothing speaks against it, and {_checks(passed)} speak{'s' * (passed == 1)} for it."
        )
    worst = [check.text for check in verdict.checks if check.level == verdict.level]
    more = f" ({len(worst) - 1} more like this below)" if len(worst) > 1 else ""
    return f"{opening}: {worst[0].rstrip('.')}{more}." if worst else f"{opening}."


def _checks(count: int) -> str:
    return f"{count} check{'s' * (count != 1)}"
