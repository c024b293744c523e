"""Settings layers: defaults, project file, session file, command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from scanloom.schemas.errors import UsageError

Overrides = dict[str, dict[str, Any]]
PROJECT_FILE = "scanloom.yaml"


def project_settings(path: Path | None) -> Overrides:
    """Settings of the project file; `scanloom.yaml` of the working folder when none is named."""
    if path is None:
        path = Path(PROJECT_FILE)
        if not path.exists():
            return {}
    try:
        body = yaml.safe_load(path.read_text()) or {}
    except (OSError, yaml.YAMLError) as error:
        raise UsageError(f"cannot be read: {error}", where=str(path)) from error
    return checked_overrides(body, str(path))


def command_line_settings(assignments: Sequence[str]) -> Overrides:
    """`stage.field=value` pairs; values are YAML, so `true`, `0.4` and `[1, 2]` mean what they say."""
    settings: Overrides = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        stage, dot, field = name.partition(".")
        if not (equals and dot and stage and field):
            raise UsageError(
                f"--set {assignment} is not of the form stage.field=value",
                next_step="for instance --set odometry.voxel_size_m=0.4",
            )
        try:
            settings.setdefault(stage, {})[field] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise UsageError(f"--set {assignment}: the value is not YAML: {error}") from error
    return settings


def merged(*layers: Mapping[str, Mapping[str, Any]]) -> Overrides:
    """Later layers win, field by field."""
    out: Overrides = {}
    for layer in layers:
        for stage, fields in layer.items():
            out.setdefault(stage, {}).update(fields)
    return out


def checked_overrides(body: Any, where: str) -> Overrides:
    """`{stage: {field: value}}`, or an error that says what is expected."""
    if not isinstance(body, dict) or not all(isinstance(fields, dict) for fields in body.values()):
        raise UsageError(
            "settings must be a mapping of stages to fields",
            where=where,
            next_step="write for instance\n  odometry:\n    voxel_size_m: 0.4",
        )
    return body
