"""The verdict: one word, and every check behind it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.session import Session
from scanloom.stages.report.figures import Figures, number

Level = Literal["pass", "note", "warn", "fail"]


LEAST_PATCHES = 200
"""Fewer patches of walls say nothing of the map."""
BLIND_WAY_M = 5.0
"""Shorter ways without a view of every direction are not worth a word."""


@dataclass(frozen=True)
class Check:
    """One thing looked at: how it went, in a sentence."""

    level: Level
    text: str


@dataclass(frozen=True)
class Limits:
    """From which value on a check warns, and fails."""

    unreliable_warn: float
    unreliable_fail: float
    gnss_warn_m: float
    gnss_fail_m: float
    ate_warn_m: float
    drift_warn_percent: float
    open_path_warn_m: float
    double_warn: float = 0.05
    double_fail: float = 0.3


@dataclass(frozen=True)
class Verdict:
    """The word, its level, and the checks with the worst first."""

    word: str
    level: Level
    checks: list[Check]


_ORDER: dict[Level, int] = {"fail": 0, "warn": 1, "note": 2, "pass": 3}
_WORDS: dict[Level, str] = {"fail": "Poor", "warn": "Fair", "note": "Good", "pass": "Good"}


def judge(
    limits: Limits,
    sessions: dict[str, Session],
    figures: Figures,
    gnss_median_m: dict[str, float],
    graph: Graph,
) -> Verdict:
    """Run all checks; the worst of them gives the word."""
    checks = [*_map_checks(limits, sessions, figures), *_graph_checks(graph)]
    for name, session in sessions.items():
        checks += _session_checks(limits, name, session, figures, gnss_median_m.get(name))
    checks.sort(key=lambda check: _ORDER[check.level])
    worst = checks[0].level if checks else "fail"
    return Verdict(_WORDS[worst], worst, checks)


def _map_checks(limits: Limits, sessions: Iterable[str], figures: Figures) -> Iterator[Check]:
    points = figures.get("map.points") or 0
    if not points:
        yield Check("fail", "The map holds no points.")
    accepted = figures.get("loops.accepted") or 0
    precision = figures.get("loops.precision")
    level: Level
    if precision is not None and precision < 1.0:
        yield Check("fail", f"{100 * (1 - precision):.1f} % of the accepted loops are wrong.")
    elif precision is not None:
        yield Check("pass", "All accepted loops that truth can judge are right.")
    elif accepted:
        yield Check("pass", f"{number(accepted)} loops hold the map together.")
    apart_m = figures.get("fusion.inter_session_rmse_m")
    if apart_m is not None:
        level = _level(apart_m, limits.ate_warn_m, 10 * limits.ate_warn_m)
        yield Check(level, f"Sessions lie within {apart_m:.2f} m of each other where they meet, by truth.")
    yield from _wall_checks(limits, figures)
    georeferenced = bool(figures.get("fusion.georeferenced"))
    if not georeferenced:
        yield Check(
            "note", "The map is not georeferenced: no usable GNSS. Coordinates start at the first scan."
        )
    if not georeferenced and not accepted:
        path_m = sum(figures.get("fusion.path_length_m", name) or 0.0 for name in sessions)
        level = "warn" if path_m > limits.open_path_warn_m else "note"
        yield Check(level, "Neither GNSS nor a loop bounds the drift: accuracy falls with distance driven.")


def _wall_checks(limits: Limits, figures: Figures) -> Iterator[Check]:
    """What users see first when passes do not fit."""
    share, patches = figures.get("map.wall_double_share"), figures.get("map.wall_patches") or 0.0
    if share is None or patches < LEAST_PATCHES:
        return
    level = _level(share, limits.double_warn, limits.double_fail)
    if level == "pass":
        yield Check(level, f"Walls are single: {100 * share:.1f} % of {number(patches)} patches look double.")
        return
    gap_m = figures.get("map.wall_double_gap_median_m")
    apart = "" if gap_m is None else f", {100 * gap_m:.0f} cm apart in the middle"
    yield Check(
        level, f"Walls are double in {100 * share:.0f} % of {number(patches)} patches{apart}: passes do not fit."
    )  # fmt: skip


def _graph_checks(graph: Graph) -> Iterator[Check]:
    """What the making of the poses has to say."""
    for text in graph.warnings:
        yield Check("warn", _sentence(text))
    for text in graph.remarks:
        yield Check("note", _sentence(text))


def _sentence(text: str) -> str:
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _session_checks(
    limits: Limits, name: str, session: Session, figures: Figures, gnss_m: float | None
) -> Iterator[Check]:
    scans, unreliable = (
        figures.get("odometry.scans", name),
        figures.get("odometry.unreliable_scans", name) or 0.0,
    )
    if not scans:
        yield Check("fail", f"{name}: no scan has a pose.")
    else:
        level = _level(unreliable / scans, limits.unreliable_warn, limits.unreliable_fail)
        registered = f"{name}: {number(scans - unreliable)} of {number(scans)} scans registered"
        bridged = f", {number(unreliable)} bridged by prediction" if unreliable else ""
        yield Check(level, f"{registered}{bridged}.")
    if gnss_m is not None:
        level = _level(gnss_m, limits.gnss_warn_m, limits.gnss_fail_m)
        yield Check(level, f"{name}: poses and GNSS agree to {gnss_m:.2f} m (median, horizontal).")
    yield from _blind_checks(name, figures)
    yield from _truth_checks(limits, name, figures)
    yield from _input_checks(name, session)


def _blind_checks(name: str, figures: Figures) -> Iterator[Check]:
    """Where odometry guessed: the other sensors and loops had to decide."""
    longest_m = figures.get("odometry.degenerate_longest_m", name) or 0.0
    if longest_m >= BLIND_WAY_M:
        share = 100 * (figures.get("odometry.degenerate_share", name) or 0.0)
        yield Check(
            "note",
            f"{name}: {share:.1f} % of the scans did not see every direction of motion, over {longest_m:.0f} m at the longest.",
        )
    segments = figures.get("odometry.segments", name)
    if segments:
        yield Check(
            "note",
            f"{name}: odometry lost the motion and began anew {number(segments - 1)} time{'s' * (segments > 2)}.",
        )


def _truth_checks(limits: Limits, name: str, figures: Figures) -> Iterator[Check]:
    ate = figures.get("fusion.ate_rmse_m", name)
    if ate is not None:
        level = _level(ate, limits.ate_warn_m, 10 * limits.ate_warn_m)
        yield Check(level, f"{name}: trajectory within {ate:.2f} m of truth (ATE, root mean square).")
    believed = figures.get("gnss.wrong_used", name)
    if believed:
        yield Check("warn", f"{name}: {number(believed)} GNSS fixes in use are wrong.")
    drift = figures.get("odometry.kitti_t_rel_percent", name)
    if drift is not None:
        level = _level(drift, limits.drift_warn_percent, 5 * limits.drift_warn_percent)
        yield Check(level, f"{name}: odometry drifts {drift:.2f} % of the distance driven.")


def _input_checks(name: str, session: Session) -> Iterator[Check]:
    if not session.complete:
        yield Check("warn", f"{name}: the log is incomplete; only what could be read is mapped.")
    errors = [problem for problem in session.problems if problem.severity == "error"]
    warnings = [problem for problem in session.problems if problem.severity == "warning"]
    if errors:
        yield Check(
            "warn",
            f"{name}: {len(errors)} serious problem{'s' * (len(errors) > 1)} in the log: {errors[0].text}",
        )
    if warnings:
        yield Check(
            "note", f"{name}: {len(warnings)} warning{'s' * (len(warnings) > 1)} about the log, listed below."
        )


def _level(value: float, warn: float, fail: float) -> Level:
    if value > fail:
        return "fail"
    return "warn" if value > warn else "pass"
