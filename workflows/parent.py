"""The map that is extended: read, checked, and its sessions found again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from scanloom.pipeline.store import Store
from scanloom.schemas.base import BaseLog
from scanloom.schemas.errors import InvalidInput, ScanloomError, UsageError
from scanloom.schemas.tiles import TileIndex
from scanloom.workflows.configuration import Overrides
from scanloom.workflows.delivery import MAP_FILE, MAP_FORMAT, read_map, trajectory_file
from scanloom.workflows.sessions import Sought, find
from scanloom.workflows.sources import SOURCES_FILE, SourceOfSession, Sources, log_digest, read_sources

MAP_AGAIN = "make the map again with `scanloom map`, then extend it"


@dataclass(frozen=True)
class Parent:
    """A finished map, ready to be extended."""

    folder: Path
    name: str
    version: int
    sha256: str
    """Of its `map.json`."""
    sessions: tuple[Sought, ...]
    """With their trajectories in this map as `BaseLog`."""
    logs: Mapping[str, str]
    """Digest of each session's log."""
    settings: Overrides
    store: Path
    files: Mapping[str, Any]
    """Size and checksum of every file of the map."""

    def reference(self) -> dict[str, Any]:
        """How `map.json` of the extension names it."""
        return {"name": self.name, "version": self.version, "sha256": self.sha256}


def read_parent(folder: Path, moved: Mapping[str, str] | None = None) -> Parent:
    """The map in `folder`. `moved` says where logs lie now, by the names of their sessions.

    Raises
    ------
    InvalidInput : there is no map, it is damaged or of another version, or a log of it is gone.
    UsageError : `moved` names a session that the map does not have.
    """
    content, digest = _map_file(folder)
    sources = read_sources(folder)
    names = [str(row["name"]) for row in content["sessions"]]
    _check_names(folder, names, sources, moved or {})
    rows = {row.name: row for row in sources.sessions}
    sessions = [_found(folder, rows[name], (moved or {}).get(name)) for name in names]
    files = {name: trajectory_file(name, len(names)) for name in names}
    for file in files.values():
        _check_file(folder, file, content["files"])
    return Parent(
        folder=folder,
        name=str(content["name"]),
        version=int(content["version"]),
        sha256=digest,
        sessions=tuple(_with_base(s, folder, files[s.name]) for s in sessions),
        logs={str(row["name"]): str(row.get("log", "")) for row in content["sessions"]},
        settings=sources.settings,
        store=Path(sources.store),
        files=content["files"],
    )


def check_logs(parent: Parent, store: Store) -> None:
    """The logs of the map must be what they were when it was made.

    Raises
    ------
    InvalidInput : a log has changed since.
    """
    for session in parent.sessions:
        known, now = parent.logs[session.name], log_digest(session, store)
        if known and now and known != now:
            raise InvalidInput(
                f"the log of session {session.name} is not the one the map was made of",
                where=session.word,
                next_step=f"say where that one lies with --log {session.name}=PATH, or make the map again",
            )


def check_new(parent: Parent, session: Sought, store: Store) -> None:
    """A log enters a map once.

    Raises
    ------
    UsageError : the map holds this log.
    """
    digest = log_digest(session, store)
    for known in parent.sessions:
        if session.word == known.word or (digest and digest == parent.logs[known.name]):
            raise UsageError(
                f"is in the map already, as session {known.name}",
                where=session.word,
                next_step="add a log that the map does not hold yet",
            )


def altered_tiles(parent: Parent, out: Path) -> list[str]:
    """Tiles of the map in `out` that no new session reached and that are not the parent's, byte by byte."""
    old = {session.name for session in parent.sessions}
    files = read_map(out).get("files", {})
    index = TileIndex.open(out / "tiles" / "index.parquet")
    return [
        tile
        for tile, rows in index.by_tile().items()
        if set(index.sessions[rows.start].split()) <= old
        and files.get(f"tiles/{tile}.parquet") != parent.files.get(f"tiles/{tile}.parquet")
    ]


def _map_file(folder: Path) -> tuple[dict[str, Any], str]:
    path = folder / MAP_FILE
    try:
        body = path.read_bytes()
    except OSError as error:
        raise InvalidInput(
            f"holds no map: {MAP_FILE} cannot be read ({error.strerror})",
            where=str(folder),
            next_step="give the folder that `scanloom map` or `scanloom extend` filled",
        ) from error
    try:
        content = json.loads(body)
        told = content.get("format")
    except (ValueError, AttributeError) as error:
        raise InvalidInput(
            "is damaged: it is no JSON object", where=str(path), next_step=MAP_AGAIN
        ) from error
    if told != MAP_FORMAT:
        raise InvalidInput(
            f"the map is of format {told!r}; this program extends maps of format {MAP_FORMAT!r}",
            where=str(path),
            next_step="use the version of the program that made it, or " + MAP_AGAIN,
        )
    if not _is_whole(content):
        raise InvalidInput("is damaged: entries are missing", where=str(path), next_step=MAP_AGAIN)
    return content, hashlib.sha256(body).hexdigest()


def _is_whole(content: Mapping[str, Any]) -> bool:
    rows = content.get("sessions")
    return (
        {"name", "version", "files", "sessions"} <= set(content)
        and isinstance(content["version"], int)
        and isinstance(content["files"], dict)
        and isinstance(rows, list)
        and bool(rows)
        and all(isinstance(row, dict) and "name" in row for row in rows)
    )


def _check_names(folder: Path, names: list[str], sources: Sources, moved: Mapping[str, str]) -> None:
    unknown = sorted(set(names) - {row.name for row in sources.sessions})
    if unknown:
        raise InvalidInput(
            f"does not say where the log of session {unknown[0]} lies",
            where=str(folder / SOURCES_FILE),
            next_step=MAP_AGAIN,
        )
    for name in moved:
        if name not in names:
            raise UsageError(
                f"--log {name}=...: the map has no session of that name",
                where=str(folder),
                next_step=f"its sessions are {', '.join(names)}",
            )


def _found(folder: Path, row: SourceOfSession, moved_to: str | None) -> Sought:
    word = moved_to or row.word
    try:
        session = find(word)
    except ScanloomError as error:
        raise InvalidInput(
            f"the log of session {row.name} cannot be used any more: {error.what}",
            where=word,
            next_step=f"say where it lies now with --log {row.name}=PATH",
        ) from error
    return replace(session, input=replace(session.input, name=row.name, settings=row.settings))


def _check_file(folder: Path, name: str, files: Mapping[str, Any]) -> None:
    """The poses that the extension builds on must be those of the map."""
    path = folder / name
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InvalidInput(
            f"cannot be read: {error.strerror}", where=str(path), next_step=MAP_AGAIN
        ) from error
    entry = files.get(name)
    if not isinstance(entry, dict) or entry.get("sha256") != digest:
        raise InvalidInput(
            f"is not the trajectory that {MAP_FILE} describes: its checksum differs",
            where=str(path),
            next_step="run the command again that made this map; it restores the file",
        )


def _with_base(session: Sought, folder: Path, file: str) -> Sought:
    base = BaseLog(root=folder.resolve(), names=(file,))
    return replace(session, input=replace(session.input, sources={**session.input.sources, BaseLog: base}))
