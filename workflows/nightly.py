"""A fleet's night: every map, failures isolated, one summary page with the change since last night."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanloom.pipeline.progress import Progress
from scanloom.schemas.errors import EXIT_INTERNAL, EXIT_OK, EXIT_REGRESSION, EXIT_SOME_FAILED, ScanloomError
from scanloom.stages.report.page import fleet_page
from scanloom.workflows.build_map import Order, Outcome, build_map
from scanloom.workflows.configuration import merged, project_settings
from scanloom.workflows.delivery import write_text
from scanloom.workflows.fleet import Fleet, MapEntry, read_fleet, sessions_by_map
from scanloom.workflows.gate import as_it_was, worse_than
from scanloom.workflows.noise import read_noise

log = logging.getLogger(__name__)

SUMMARY_FILE = "summary.json"
PAGE_FILE = "index.html"


@dataclass(frozen=True)
class Night:
    """What a night gave."""

    page: Path
    summary: dict[str, Any]
    failures: list[str]
    regressions: list[str]
    exit_code: int


def run_fleet(
    fleet_file: Path,
    out: Path | None,
    store: Path,
    *,
    cluster: str = "local",
    workers: int | None = None,
    progress: Progress | None = None,
) -> Night:
    """Make every map of a fleet file and write the summary.

    A log or a map that fails is named with its cause and leaves the others alone. With `gate`, each map is held against the
    one that its folder held before.

    Raises
    ------
    UsageError : the fleet file itself cannot be used.
    InvalidInput : the file of noise cannot.
    """
    fleet = read_fleet(fleet_file)
    noise = read_noise(fleet_file.parent / fleet.noise) if fleet.noise else None
    folder = out or fleet_file.parent / fleet.out
    last_night = _read_summary(folder / SUMMARY_FILE)
    rows: list[dict[str, Any]] = []
    maps = sessions_by_map(fleet, fleet_file.parent)
    started = time.monotonic()
    for name, sessions in maps.items():
        _say_how_far(name, len(rows), len(maps), time.monotonic() - started)
        order = _order(name, sessions, fleet, folder, store)
        order = dataclasses.replace(order, cluster=cluster, workers=workers)
        before = as_it_was(order.out) if fleet.gate else None
        row = _row(name, sessions, _make(order, progress), folder)
        row["regressions"] = worse_than(before, order.out, noise) if row["delivered"] else []
        row["warnings"] = [*row["warnings"], *row["regressions"]]
        rows.append(row)
    made = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    summary: dict[str, Any] = {"maps": rows, "made": made}
    write_text(folder / PAGE_FILE, fleet_page(with_changes(rows, last_night), made=made))
    write_text(folder / SUMMARY_FILE, json.dumps(summary, indent=1) + "\n")
    failures = [f"{row['map']}: {failure}" for row in rows for failure in row["failures"]]
    worse = [f"{row['map']}: {text}" for row in rows for text in row["regressions"]]
    return Night(folder / PAGE_FILE, summary, failures, worse, _exit_code(rows))


def _say_how_far(name: str, made: int, maps: int, passed_s: float) -> None:
    """With the time left, when the maps to come take as long as those before."""
    left = f", about {passed_s / made * (maps - made) / 60.0:.0f} min left" if made else ""
    log.info("map %d of %d: %s%s", made + 1, maps, name, left)


def _order(name: str, sessions: list[str], fleet: Fleet, folder: Path, store: Path) -> Order:
    entry = fleet.maps.get(name, MapEntry(sessions=sessions))
    return Order(
        sessions=tuple(sessions),
        out=folder / "maps" / name,
        name=name,
        store=store,
        project=merged(project_settings(None), fleet.settings, entry.settings),
        started_s=time.time(),
    )


def _make(order: Order, progress: Progress | None) -> Outcome:
    """One map; whatever goes wrong in it is an outcome, not the end of the night."""
    try:
        return build_map(order, progress)
    except ScanloomError as error:
        return Outcome(order.out, error.exit_code, False, [], 0, [(order.name, error)], [])
    except Exception as error:
        log.exception("map %s", order.name)
        wrapped = ScanloomError(f"{type(error).__name__}: {error}", next_step="see the log of this run")
        return Outcome(order.out, EXIT_INTERNAL, False, [], 0, [(order.name, wrapped)], [])


def _row(name: str, sessions: list[str], outcome: Outcome, folder: Path) -> dict[str, Any]:
    return {
        "map": name,
        "sessions": [Path(session).name for session in sessions],
        "delivered": outcome.delivered,
        "report": (outcome.out / "report.html").relative_to(folder).as_posix() if outcome.delivered else None,
        "executed": outcome.executed,
        "metrics": outcome.metrics,
        "warnings": outcome.warnings,
        "failures": [str(error) for _, error in outcome.failures],
    }


def with_changes(rows: list[dict[str, Any]], last_night: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each metric with its value of last night under `previous`, where there was one."""
    before = {
        (row["map"], m["name"], m.get("session", "")): m["value"]
        for row in last_night
        for m in row["metrics"]
    }
    return [
        {
            **row,
            "new": row["map"] not in {r["map"] for r in last_night},
            "metrics": [
                {**m, "previous": before.get((row["map"], m["name"], m.get("session", "")))}
                for m in row["metrics"]
            ],
        }
        for row in rows
    ]


def _read_summary(path: Path) -> list[dict[str, Any]]:
    try:
        rows: list[dict[str, Any]] = json.loads(path.read_text())["maps"]
        return rows
    except (OSError, ValueError, KeyError):
        return []


def _exit_code(rows: list[dict[str, Any]]) -> int:
    if any(row["failures"] for row in rows):
        return EXIT_SOME_FAILED
    return EXIT_REGRESSION if any(row["regressions"] for row in rows) else EXIT_OK
