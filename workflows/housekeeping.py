"""The store for people: explain, status, verify, gc as plain data and as text."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from typing import Any

from scanloom.pipeline.store import Store, explain
from scanloom.schemas.errors import UsageError

Json = dict[str, Any]


def _open(folder: Path) -> Store:
    if not folder.is_dir():
        raise UsageError(
            "there is no store here", where=str(folder), next_step="give --store, or map something first"
        )
    return Store(folder)


def explanation(store: Path, artifact: str) -> Json:
    """Why one artifact is what it is. `artifact` is a key, the start of one, or the artifact's folder."""
    found = explain(_open(store), Path(artifact).name if "/" in artifact else artifact)
    outputs = [
        {"path": f.path, "bytes": f.size, "sha256": f.sha256}
        for part in found.artifact.parts
        for f in part.files
    ]
    return {
        "stage": found.artifact.stage,
        "key": found.artifact.key,
        "folder": str(found.artifact.folder),
        "coordinate": found.coordinate,
        "settings": found.settings,
        "code": found.code,
        "inputs": [dataclasses.asdict(i) for i in found.inputs],
        "outputs": outputs,
        "before": found.before,
        "changes": found.changes,
    }


def text_of_explanation(found: Json) -> str:
    lines = [
        f"{found['stage']} {'/'.join(found['coordinate'].values())}   {found['key']}",
        f"in {found['folder']}",
        "settings  " + json.dumps(found["settings"]),
        "code      " + json.dumps(found["code"]),
    ]
    for i in found["inputs"]:
        made_by = ", ".join(i["made_by"]) or "a file from outside"
        lines.append(
            f"reads     {i['product']} ({i['parts']} part{'s' * (i['parts'] != 1)}) made by {made_by}"
        )
    lines += [f"wrote     {o['path']}  {o['bytes']} bytes  {o['sha256'][:16]}" for o in found["outputs"]]
    if found["before"]:
        lines.append(f"since {found['before'][:16]}: " + "; ".join(found["changes"] or ["nothing"]))
    return "\n".join(lines)


def store_status(store: Path) -> Json:
    """What the store holds, and how the last runs ended."""
    found = _open(store).status()
    return {
        "root": str(found.root),
        "bytes": found.bytes,
        "stages": [dataclasses.asdict(s) for s in found.stages],
        "runs": [dataclasses.asdict(r) for r in found.runs],
        "failures": [{"task": task, "error": error} for task, error in found.failures],
        "leftovers": found.leftovers,
        "quarantined": found.quarantined,
    }


def text_of_status(found: Json) -> str:
    lines = [f"{found['root']}   {found['bytes'] / 1e6:.1f} MB"]
    lines += [
        f"  {s['stage']:12} {s['artifacts']:6} artifacts {s['bytes'] / 1e6:10.1f} MB" for s in found["stages"]
    ]
    for r in found["runs"]:
        when = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(r["started_unix_s"]))
        counts = ", ".join(f"{n} {verdict}" for verdict, n in sorted(r["verdicts"].items()))
        lines.append(f"run {r['number']:4}  {when}  {r['state']:11} {r['wall_s']:8.1f} s  {counts}")
    lines += [f"failed: {f['task']}: {f['error']}" for f in found["failures"]]
    if found["leftovers"] or found["quarantined"]:
        lines.append(
            f"{found['leftovers']} leftovers, {found['quarantined']} in quarantine; `scanloom gc` removes them"
        )
    return "\n".join(lines)


def verify_store(store: Path) -> Json:
    """Every byte read again; damaged artifacts are set aside."""
    opened = _open(store)
    checked = sum(1 for _ in opened.artifacts())
    problems = opened.verify()
    return {
        "checked": checked,
        "problems": [f"{p.stage}/{p.key}: {p.path}: {p.what}; moved to {p.moved_to}" for p in problems],
    }


def collect_garbage(store: Path, keep_runs: int, dry_run: bool) -> Json:
    """Drop what the last runs did not use."""
    garbage = _open(store).gc(keep_runs=keep_runs, dry_run=dry_run)
    return {
        "artifacts": len(garbage.artifacts),
        "leftovers": len(garbage.leftovers),
        "bytes": garbage.bytes,
        "dry_run": dry_run,
    }
