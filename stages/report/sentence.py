"""The verdict as one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from scanloom.stages.report.figures import Figures, number
from scanloom.stages.report.verdict import Level, Verdict

_OPENINGS: dict[Level, str] = {
    "fail": "Do not rely on this map as it is",
    "warn": "This map is usable with care",
    "note": "This map can be relied on",
    "pass": "This map can be relied on",
}


def sentence(verdict: Verdict, evidence: Sequence[str] = ()) -> str:
    """How far to trust the map: the worst that was found, or that nothing was and what speaks for the map."""
    opening = _OPENINGS[verdict.level]
    if verdict.level not in ("fail", "warn"):
        passed = sum(check.level == "pass" for check in verdict.checks)
        told = _listed(evidence) if evidence else f"{number(passed)} check{'s' if passed != 1 else ''} passed"
        return f"{opening}: no check warns; {told}."
    worst = [check.text.rstrip(".") for check in verdict.checks if check.level == verdict.level]
    more = f" ({len(worst) - 1} more like this below)" if len(worst) > 1 else ""
    return f"{opening}: {worst[0]}{more}." if worst else f"{opening}."


def evidence(sessions: Sequence[str], figures: Figures, gnss_median_m: Sequence[float]) -> list[str]:
    """What speaks for a map: truth, GNSS, loops, as far as there are any; of several sessions the worst."""
    found = []
    errors = [value for name in sessions if (value := figures.get("fusion.ate_rmse_m", name)) is not None]
    if errors:
        found.append(f"its trajectory lies within {max(errors):.2f} m of truth")
    if gnss_median_m:
        found.append(f"it agrees with GNSS to {max(gnss_median_m):.2f} m")
    loops = figures.get("loops.accepted") or 0
    if loops:
        found.append(f"{number(loops)} loop{'s hold' if loops != 1 else ' holds'} it together")
    return found


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
