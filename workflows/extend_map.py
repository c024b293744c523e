"""Extension: new sessions added to a finished map, as a new version of it with a parent."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from scanloom.schemas.errors import UsageError
from scanloom.workflows.build_map import Order
from scanloom.workflows.configuration import Overrides, merged
from scanloom.workflows.parent import Parent


def extension_order(
    parent: Parent,
    sessions: Sequence[str],
    *,
    out: Path | None,
    store: Path | None,
    mode: str,
    project: Overrides,
    command_line: Overrides,
    cluster: str = "local",
    workers: int | None = None,
    started_s: float | None = None,
) -> Order:
    """The order for a map of the parent's sessions and new ones; what was set for the parent holds again.

    Raises
    ------
    UsageError : the new version would overwrite the map it extends.
    """
    folder = out or next_folder(parent)
    if folder.resolve() == parent.folder.resolve():
        raise UsageError(
            "is the map that is extended; it is left as it is",
            where=str(folder),
            next_step="give --out another folder, or leave it out",
        )
    return Order(
        sessions=tuple(sessions),
        out=folder,
        name=folder.name,
        store=store or parent.store,
        cluster=cluster,
        workers=workers,
        project=project,
        command_line=merged(command_line, {"fusion": {"extension": mode}}),
        parent=parent,
        started_s=time.time() if started_s is None else started_s,
    )


def next_folder(parent: Parent) -> Path:
    """Beside the parent: `sample-v2` after `sample`, `sample-v3` after that."""
    stem = re.sub(rf"-v{parent.version}$", "", parent.folder.resolve().name)
    return parent.folder.parent / f"{stem}-v{parent.version + 1}"


def moved_logs(assignments: Sequence[str]) -> Mapping[str, str]:
    """`NAME=PATH` pairs: where the log of a session lies now.

    Raises
    ------
    UsageError : one of them is not of that form.
    """
    moved = {}
    for assignment in assignments:
        name, equals, path = assignment.partition("=")
        if not (name and equals and path):
            raise UsageError(
                f"--log {assignment} is not of the form NAME=PATH",
                next_step="for instance --log monday=/data/monday.bag",
            )
        moved[name] = path
    return moved
