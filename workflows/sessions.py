"""What the user calls a SESSION, turned into an input of a run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from scanloom.pipeline.plan import SessionInput
from scanloom.schemas.errors import ScanloomError, UsageError
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.stages.logs.locate import locate
from scanloom.workflows.map_session import SIMULATED

SAMPLE = "sample"


def find_sessions(names: Sequence[str]) -> tuple[list[SessionInput], list[tuple[str, ScanloomError]]]:
    """Inputs for every SESSION that can be found, and the error of each that cannot; one never stops another."""
    found: list[SessionInput] = []
    errors: list[tuple[str, ScanloomError]] = []
    for name in names:
        try:
            found.append(_find(name))
        except ScanloomError as error:
            errors.append((name, error))
    return _with_unique_names(found), errors


def _find(name: str) -> SessionInput:
    if name == SAMPLE and not Path(name).exists():
        return SessionInput(name=SAMPLE, sources={}, tags=frozenset({SIMULATED}))
    log = locate(Path(name))
    return SessionInput(
        name=re.sub(r"[^A-Za-z0-9._-]+", "-", log.name).strip("-.") or "session",
        sources={RawLog: log.raw_log, TruthLog: log.truth_log},
        settings=log.settings,
    )


def _with_unique_names(sessions: list[SessionInput]) -> list[SessionInput]:
    seen: dict[str, int] = {}
    unique = []
    for session in sessions:
        count = seen[session.name] = seen.get(session.name, 0) + 1
        name = session.name if count == 1 else f"{session.name}-{count}"
        unique.append(SessionInput(name, session.sources, session.settings, session.tags))
    return unique


def map_name(sessions: Sequence[str]) -> str:
    """Name of the map's folder when the user gives none: the first session's."""
    first = sessions[0]
    if first == SAMPLE:
        return SAMPLE
    path = Path(first).resolve()
    name = path.stem if path.is_file() or path.suffix else path.name
    cleaned = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")
    if not cleaned:
        raise UsageError(f"no name can be made from {first}", next_step="give --out FOLDER")
    return cleaned
