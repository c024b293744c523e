"""Why a task runs: its identity against the artifacts that are there already."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from scanloom.pipeline.flow import Task
from scanloom.pipeline.store import Artifact, Store
from scanloom.pipeline.task import Json


class History:
    """Artifacts of a store by stage, read once, when a reason is asked for."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._stages: dict[str, list[Artifact]] = {}

    def reason(self, task: Task, identity: Json) -> str:
        """Why there is no artifact of this identity yet: what differs from the nearest one."""
        nearest = self.nearest(task, identity)
        if nearest is None:
            return "new input" if self._of(task.node.name) else "not computed yet"
        return "; ".join(differences(nearest.identity, identity)) or "its artifact is gone"

    def nearest(self, task: Task, identity: Json) -> Artifact | None:
        """The artifact of this stage at the same coordinate that differs least, the latest among equals."""
        place = [list(pair) for pair in task.coordinate]
        here = [a for a in self._of(task.node.name) if a.run.get("coordinate") == place]
        return min(
            here,
            key=lambda a: (len(list(differences(a.identity, identity))), -a.run.get("finished_unix_s", 0.0)),
            default=None,
        )

    def computed_with(self, task: Task, constant: Json) -> bool:
        """Is there an artifact of this stage with the same code and settings?"""
        return any(
            all(a.identity.get(name) == value for name, value in constant.items())
            for a in self._of(task.node.name)
        )

    def _of(self, stage: str) -> list[Artifact]:
        if stage not in self._stages:
            self._stages[stage] = list(self._store.artifacts(stage))
        return self._stages[stage]


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What changed between two identities, in words."""
    settings_of = new.get("settings_of", new.get("stage"))
    return [
        *_settings(f"settings.{settings_of}", old.get("settings", {}), new.get("settings", {})),
        *_code(old.get("code", {}), new.get("code", {}), str(new.get("stage"))),
        *_inputs(old.get("inputs"), new.get("inputs")),
        *(["layout of the store"] if old.get("schema") != new.get("schema") else []),
    ]


def _settings(path: str, old: Any, new: Any) -> Iterator[str]:
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for name in sorted({*old, *new}):
            yield from _settings(f"{path}.{name}", old.get(name), new.get(name))
    elif old != new:
        yield f"{path} {old} -> {new}"


def _code(old: Mapping[str, Any], new: Mapping[str, Any], stage: str) -> Iterator[str]:
    if old.get("version") != new.get("version"):
        yield f"version of {stage} {old.get('version')} -> {new.get('version')}"
    before, after = old.get("modules", {}), new.get("modules", {})
    changed = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
    if changed:
        shown = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
        yield f"code of {stage} changed: {shown}"
    before, after = old.get("libraries", {}), new.get("libraries", {})
    for name in sorted({*before, *after}):
        if before.get(name) != after.get(name):
            yield f"{name} {before.get(name, 'unused')} -> {after.get(name, 'unused')}"


def _inputs(old: Any, new: Any) -> Iterator[str]:
    if old is None or new is None:
        return
    before = {entry["product"]: entry["parts"] for entry in old}
    after = {entry["product"]: entry["parts"] for entry in new}
    for name in sorted({*before, *after}):
        if before.get(name) != after.get(name):
            yield f"input {name} changed"
