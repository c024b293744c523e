"""`sources.json`: where a map's logs lie and how it was made, so that it can be made again and extended.

It stands beside `map.json`, and is no part of the map: it names paths of the machine the map was made on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from scanloom.pipeline.identity import git_commit
from scanloom.pipeline.run import Result
from scanloom.pipeline.settings import resolve
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.session import RawLog
from scanloom.schemas.trajectory import Poses
from scanloom.workflows.configuration import Overrides, merged
from scanloom.workflows.delivery import write_text
from scanloom.workflows.map_session import NODES, SIMULATED
from scanloom.workflows.sessions import Sought

SOURCES_FILE = "sources.json"
SOURCES_FORMAT = "scanloom sources 1"


class SourceOfSession(BaseModel):
    """One session of a map: its name there, the log, and what is set for it alone."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    word: str
    """Absolute path of the log, or the word of a simulated one."""
    settings: dict[str, dict[str, Any]]


class Sources(BaseModel):
    """How a map was made."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: str
    sessions: tuple[SourceOfSession, ...]
    settings: dict[str, dict[str, Any]]
    """Of the project file and the command line, merged."""
    store: str
    program: str = ""
    """Version of the program, and the commit where it ran from a checkout."""


def write_sources(
    out: Path, sessions: Iterable[Sought], settings: Mapping[str, Mapping[str, Any]], store: Path
) -> None:
    """Remember how the map in `out` was made."""
    rows = tuple(
        SourceOfSession(name=s.name, word=s.word, settings=_lasting_settings(s, settings)) for s in sessions
    )
    kept = _without_mode(settings)
    program = " ".join(filter(None, (metadata.version("scanloom"), git_commit()[:12])))
    sources = Sources(
        format=SOURCES_FORMAT, sessions=rows, settings=kept, store=str(store.resolve()), program=program
    )
    write_text(out / SOURCES_FILE, sources.model_dump_json(indent=1) + "\n")


def read_sources(folder: Path) -> Sources:
    """What `write_sources` wrote.

    Raises
    ------
    InvalidInput : the file is missing, damaged, or of another version.
    """
    path = folder / SOURCES_FILE
    remade = "make the map again with `scanloom map`, then extend it"
    try:
        text = path.read_text()
        told = json.loads(text).get("format")
        if told != SOURCES_FORMAT:
            raise InvalidInput(
                f"is of format {told!r}, not {SOURCES_FORMAT!r}", where=str(path), next_step=remade
            )
        return Sources.model_validate_json(text)
    except FileNotFoundError as error:
        raise InvalidInput(
            "is missing: nothing says which logs the map was made of", where=str(path), next_step=remade
        ) from error
    except (OSError, ValueError, AttributeError, ValidationError) as error:
        cause = str(error).splitlines()[0]
        raise InvalidInput(f"is damaged: {cause}", where=str(path), next_step=remade) from error


def log_digests(result: Result, sessions: Iterable[Sought], store: Store) -> dict[str, str]:
    """SHA-256 of the log of every session that is in the map; where it lies does not matter."""
    mapped = {dict(where)["session"] for where, _ in result.files(Poses)}
    digests = {
        dict(where)["session"]: part.digest
        for where, artifact in result.artifacts
        for part in artifact.of(RawLog)
        if dict(where).get("session") in mapped
    }
    for session in sessions:
        if session.name in mapped and session.name not in digests:
            digests[session.name] = log_digest(session, store)
    return digests


def log_digest(session: Sought, store: Store) -> str:
    """SHA-256 of a log's files and their names, "" for a log that is simulated.

    Raises
    ------
    InvalidInput : a file of it cannot be read.
    """
    from scanloom.pipeline.fingerprint import files_digest

    log = session.input.sources.get(RawLog)
    if log is None:
        return ""
    return files_digest(store.hashes.of({name: (log.root or Path()) / name for name in log.names}))


def _lasting_settings(session: Sought, settings: Mapping[str, Mapping[str, Any]]) -> Overrides:
    """What makes the session what it is: of a simulated one every setting of the simulator, for that is its log."""
    own = {stage: dict(fields) for stage, fields in session.input.settings.items()}
    if SIMULATED not in session.input.tags:
        return own
    simulator = tuple(n for n in NODES if n.only == SIMULATED)
    told = {"simulate": dict(merged(settings, own).get("simulate", {}))}
    return {**own, "simulate": resolve(simulator, [("settings", told)])["simulate"].model_dump(mode="json")}


def _without_mode(settings: Mapping[str, Mapping[str, Any]]) -> Overrides:
    """How one extension was made says nothing of the next."""
    kept = {
        stage: {name: value for name, value in fields.items() if (stage, name) != ("fusion", "extension")}
        for stage, fields in settings.items()
    }
    return {stage: fields for stage, fields in kept.items() if fields}
