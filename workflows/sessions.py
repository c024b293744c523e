"""What the user calls a SESSION, turned into an input of a run."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scanloom.pipeline.plan import SessionInput
from scanloom.schemas.base import BaseLog
from scanloom.schemas.errors import ScanloomError, UsageError
from scanloom.schemas.product import Files, Product
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.stages.logs.locate import locate
from scanloom.stages.simulate.settings import SECOND_DAY
from scanloom.workflows.map_session import SIMULATED

SAMPLE = "sample"
SECOND_SAMPLE = "sample2"
SIMULATED_SESSIONS: Mapping[str, Mapping[str, Any]] = {SAMPLE: {}, SECOND_SAMPLE: SECOND_DAY}
"""What the simulator is told for each of the words: `sample2` is another drive through the same town a day later."""


@dataclass(frozen=True)
class Sought:
    """A SESSION that was found."""

    word: str
    """By which it is found again from anywhere: an absolute path, or the word for a simulated one."""
    input: SessionInput

    @property
    def name(self) -> str:
        return self.input.name


def find_sessions(
    words: Sequence[str], taken: Collection[str] = ()
) -> tuple[list[Sought], list[tuple[str, ScanloomError]]]:
    """Every SESSION that can be found, by name, and the error of each that cannot; one never stops another.

    Names do not depend on the order of the words. Those in `taken` are given to none.
    """
    found: list[Sought] = []
    errors: list[tuple[str, ScanloomError]] = []
    for word in words:
        try:
            session = find(word)
            if any(session.word == other.word for other in found):
                raise UsageError("is given twice", where=word, next_step="name every log once")
            found.append(session)
        except ScanloomError as error:
            errors.append((word, error))
    return _with_unique_names(found, taken), errors


def find(word: str) -> Sought:
    """The session of this word or path, under the name it suggests.

    Raises
    ------
    InvalidInput : there is no log, or it cannot be read.
    """
    if word in SIMULATED_SESSIONS and not Path(word).exists():
        settings = {"simulate": dict(SIMULATED_SESSIONS[word])} if SIMULATED_SESSIONS[word] else {}
        new = SessionInput(word, {BaseLog: BaseLog()}, settings, frozenset({SIMULATED}))
        return Sought(word, new)
    log = locate(Path(word))
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", log.name).strip("-.") or "session"
    sources: dict[type[Product], Files] = {RawLog: log.raw_log, TruthLog: log.truth_log, BaseLog: BaseLog()}
    return Sought(str(Path(word).resolve()), SessionInput(name, sources, log.settings))


def _with_unique_names(sessions: list[Sought], taken: Collection[str]) -> list[Sought]:
    used = set(taken)
    unique = []
    for session in sorted(sessions, key=lambda s: (s.name, s.word)):
        name, count = session.name, 1
        while name in used:
            count += 1
            name = f"{session.name}-{count}"
        used.add(name)
        unique.append(replace(session, input=replace(session.input, name=name)))
    return unique


def map_name(sessions: Sequence[str]) -> str:
    """Name of the map's folder when the user gives none: the first session's."""
    first = sessions[0]
    if first in SIMULATED_SESSIONS:
        return first
    path = Path(first).resolve()
    name = path.stem if path.is_file() or path.suffix else path.name
    cleaned = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.")
    if not cleaned:
        raise UsageError(f"no name can be made from {first}", next_step="give --out FOLDER")
    return cleaned
