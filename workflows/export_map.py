"""A delivered map into formats of the outside world: files beside it, and a record of what they were made from."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from scanloom.pipeline.progress import Progress, Silent
from scanloom.schemas.errors import ScanloomError, StoreError, UsageError
from scanloom.stages.exports.clouds import box_of, part_names, points_of
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.formats import FORMATS, Format, chosen
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import HEADER, MapSource
from scanloom.workflows.delivery import write_text
from scanloom.workflows.heard import Heard

RECORD = "exports.json"
_LOCK, _PART, _OLD = ".lock", ".part", ".old"
_ALWAYS = ("scanloom", "numpy", "pyproj", "pyarrow")

Row = dict[str, Any]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Exported:
    """What one format came to."""

    name: str
    folder: Path
    row: Row
    """As it stands in `exports.json`."""
    fresh: bool
    """Written now, rather than found as it should be."""

    def as_json(self) -> Row:
        return {"format": self.name, "folder": str(self.folder), "fresh": self.fresh, **self.row}

    def text(self) -> str:
        size = sum(file["bytes"] for file in self.row["files"].values())
        state = "" if self.fresh else "   unchanged"
        return f"{self.name:11} {len(self.row['files']):5} files {size / 1e6:10.1f} MB   {self.folder}{state}"


def options_of(**fields: Any) -> Options:
    """
    Raises
    ------
    UsageError : a field is out of bounds.
    """
    try:
        return Options(**{name: value for name, value in fields.items() if value is not None})
    except ValidationError as error:
        first = error.errors()[0]
        name = "--" + str(first["loc"][0]).replace("_", "-")
        raise UsageError(
            f"{name} {first['input']}: {first['msg']}", next_step="see `scanloom export --help`"
        ) from error


def export_map(folder: Path, names: str, options: Options, out: Path | None = None) -> list[Exported]:
    """As `export_all`, and the first failure is raised when all formats are through."""
    done, failures = export_all(folder, names, options, out)
    for _, error in failures:
        raise error
    return done


def export_all(
    folder: Path, names: str, options: Options, out: Path | None = None, progress: Progress | None = None
) -> tuple[list[Exported], list[tuple[str, ScanloomError]]]:
    """Export a map to formats separated by commas; one whose files are there and were made from this very map is left alone.

    Returns what was exported, and of each format that failed its name and why: one that fails stops no other.

    Raises
    ------
    InvalidInput : the folder holds no map, or none that has a place in the system asked for.
    UsageError : a format or option does not exist, or its library is not installed.
    StoreError : the folder of the exports cannot be written.
    """
    formats = sorted(formats_of(names), key=_order)
    source = MapSource.open(folder)
    Projector.of(source, options)
    place = out or folder / "exports"
    heard = Heard(progress or Silent(), formats, len(part_names(source, options)))
    done, failures = [], []
    with _alone_in(place), heard:
        for entry in formats:
            try:
                done.append(_export(heard.listening(source, entry), entry, options, place))
            except ScanloomError as error:
                failures.append((entry.name, error))
            except Exception as error:
                log.exception("export %s", entry.name)
                failures.append((entry.name, ScanloomError(f"{type(error).__name__}: {error}")))
            else:
                heard.over(entry, done[-1].fresh)
    return done, failures


def _order(entry: Format) -> bool:
    """What lists the other exports comes after them."""
    return entry.lists_others


def formats_of(names: str) -> list[Format]:
    """Formats separated by commas.

    Raises
    ------
    UsageError : a name that no format has, or a format whose library is not installed.
    """
    return chosen([name.strip().lower() for name in names.split(",") if name.strip()])


def known_formats() -> list[Row]:
    """Name and one sentence of every format, and what it needs that is not part of every installation."""
    return [
        {"format": entry.name, "doc": entry.doc, "extra": entry.extra, "needs": list(entry.needs)}
        for entry in FORMATS.values()
    ]


def read_record(place: Path) -> dict[str, Row]:
    """Content of `exports.json`, format by format; empty when there is none or it was cut off."""
    try:
        content: dict[str, Row] = json.loads((place / RECORD).read_text())["formats"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return content


def _export(source: MapSource, entry: Format, options: Options, place: Path) -> Exported:
    made_from = _made_from(source, entry, options)
    if entry.lists_others:
        made_from["others"] = _digest_of(
            {name: row["files"] for name, row in read_record(place).items() if name != entry.name}
        )
        made_from["beside"] = _unrecorded(source)
    folder = place / entry.name
    known = read_record(place).get(entry.name, {})
    if known.get("made_from") == made_from and _as_recorded(folder, known):
        return Exported(entry.name, folder, known, fresh=False)
    try:
        files = _write_beside(source, entry, options, folder)
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error.strerror}",
            where=str(folder),
            next_step="free space or fix the permissions, then run the same command again",
        ) from error
    row = {"made_from": made_from, "files": files, **_facts(source, entry, options)}
    _keep(place, entry.name, row)
    return Exported(entry.name, folder, row, fresh=True)


def _write_beside(source: MapSource, entry: Format, options: Options, folder: Path) -> dict[str, Row]:
    """Fill a folder beside the final one, then put it in its place; returns the files with their checksums."""
    part, old = (folder.with_name(f".{folder.name}{ending}") for ending in (_PART, _OLD))
    for leftover in (part, old):
        shutil.rmtree(leftover, ignore_errors=True)
    part.mkdir()
    try:
        paths = entry.write(source, part, options)
        files = {str(path.relative_to(part)): _digest(path) for path in sorted(paths)}
        _forget(folder.parent, entry.name)
        if folder.exists():
            os.replace(folder, old)
        os.replace(part, folder)
    finally:
        for leftover in (part, old):
            shutil.rmtree(leftover, ignore_errors=True)
    return files


def _made_from(source: MapSource, entry: Format, options: Options) -> Row:
    """What decides about the bytes of an export."""
    versions = {}
    for name in (*_ALWAYS, *entry.needs):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "unknown"
    return {
        "map": hashlib.sha256((source.folder / HEADER).read_bytes()).hexdigest(),
        "options": options.model_dump(),
        "format_version": entry.version,
        "versions": versions,
    }


def _digest_of(body: Any) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()


def _facts(source: MapSource, entry: Format, options: Options) -> Row:
    """What a reader of the record wants to know of the points."""
    projector = Projector.of(source, options)
    facts: Row = {
        "map": {"name": source.name, "version": source.header.get("version")},
        "crs": {
            "epsg": projector.epsg,
            "vertical_epsg": projector.vertical_epsg,
            "heights": projector.heights,
            "operation": projector.operation,
        },
        "what": entry.doc,
    }
    if entry.cloud:
        facts["points"] = points_of(source, options)
        facts["box_m"] = box_of(source, projector, options).tolist()
    return facts


def _unrecorded(source: MapSource) -> dict[str, str]:
    """Checksums of what lies in the map's folder and changes without the map, as the report does."""
    recorded = {HEADER, *source.header.get("files", {})}
    paths = sorted(p for p in source.folder.iterdir() if p.is_file() and not p.name.startswith("."))
    return {p.name: _digest(p)["sha256"] for p in paths if p.name not in recorded}


def _as_recorded(folder: Path, row: Row) -> bool:
    """Whether every recorded file is there in its length."""
    try:
        return all((folder / name).stat().st_size == file["bytes"] for name, file in row["files"].items())
    except OSError:
        return False


def _digest(path: Path) -> Row:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
        return {"sha256": hashlib.file_digest(stream, "sha256").hexdigest(), "bytes": path.stat().st_size}


def _forget(place: Path, name: str) -> None:
    """Before files are replaced: a record never speaks of files that are not there."""
    rows = read_record(place)
    if rows.pop(name, None) is not None:
        _write_record(place, rows)


def _keep(place: Path, name: str, row: Row) -> None:
    _write_record(place, read_record(place) | {name: row})


def _write_record(place: Path, rows: dict[str, Row]) -> None:
    write_text(place / RECORD, json.dumps({"formats": rows}, indent=1, sort_keys=True) + "\n")


@contextmanager
def _alone_in(place: Path) -> Iterator[None]:
    """Make the folder and hold it, so that two exports never write into it at once.

    Raises
    ------
    StoreError : it cannot be made or written.
    UsageError : another export is at work there.
    """
    try:
        place.mkdir(parents=True, exist_ok=True)
        stream = (place / _LOCK).open("w")
    except OSError as error:
        raise StoreError(
            f"cannot be written: {error.strerror}",
            where=str(place),
            next_step="give --out a folder that can be",
        ) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise UsageError(
                "another export is writing here",
                where=str(place),
                next_step="wait for it, or give another --out",
            ) from error
        yield
