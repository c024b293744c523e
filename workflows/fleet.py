"""The file that names a fleet's logs: which sessions make which map."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from scanloom.schemas.errors import UsageError
from scanloom.workflows.configuration import checked_overrides
from scanloom.workflows.sessions import SIMULATED_SESSIONS, map_name


class MapEntry(BaseModel):
    """One map: its logs (paths or globs, relative to the fleet file) and its settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sessions: list[str] = Field(min_length=1)
    settings: dict[str, dict[str, Any]] = {}


class Fleet(BaseModel):
    """All maps of a night."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    maps: dict[str, MapEntry] = {}
    each: list[str] = Field(
        default=[], description="paths or globs; every log that matches becomes a map of its own"
    )
    out: str = Field(default="night", description="folder of maps and summary, relative to the fleet file")
    settings: dict[str, dict[str, Any]] = {}
    gate: bool = Field(
        default=False, description="end with exit code 5 when a map is worse than the one of the night before"
    )
    noise: str | None = Field(
        default=None,
        description="file of noise for the gate, relative to the fleet file; else default tolerances",
    )


def read_fleet(path: Path) -> Fleet:
    """Parse and check FLEET.yaml.

    Raises
    ------
    UsageError : the file is missing, not YAML, or has unknown or missing entries.
    """
    try:
        fleet = Fleet.model_validate(yaml.safe_load(path.read_text()) or {})
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"is not YAML: {error}", where=str(path)) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise UsageError(
            f"{place}: {first['msg']}",
            where=str(path),
            next_step="known entries: maps, each, out, settings, gate, noise",
        ) from error
    checked_overrides(fleet.settings, str(path))
    if not fleet.maps and not fleet.each:
        raise UsageError("names no logs", where=str(path), next_step="list them under `maps` or `each`")
    return fleet


def sessions_by_map(fleet: Fleet, base: Path) -> dict[str, list[str]]:
    """Every map's logs with globs expanded, sorted; a glob that matches nothing stays as it is and fails by name."""
    maps = {
        name: [log for pattern in entry.sessions for log in _expand(pattern, base)]
        for name, entry in fleet.maps.items()
    }
    for pattern in fleet.each:
        for log in _expand(pattern, base):
            name = map_name([log])
            unique, count = name, 1
            while unique in maps:
                count += 1
                unique = f"{name}-{count}"
            maps[unique] = [log]
    return maps


def _expand(pattern: str, base: Path) -> list[str]:
    if pattern in SIMULATED_SESSIONS:
        return [pattern]
    full = str(base / pattern)
    return sorted(glob.glob(full)) or [full]
