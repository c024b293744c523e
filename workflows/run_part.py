"""What a report says of the run that made it: times, memory, settings that were changed, provenance with checksums."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from scanloom.pipeline.identity import git_commit
from scanloom.pipeline.run import Result
from scanloom.pipeline.settings import resolve
from scanloom.stages.report.run import Changed, File, Log, Run, StageTime
from scanloom.workflows.configuration import Overrides
from scanloom.workflows.delivery import MAP_FILE, Metric
from scanloom.workflows.map_session import NODES
from scanloom.workflows.sessions import Sought

LIBRARIES = ("numpy", "scipy", "numba", "gtsam", "small_gicp", "pyproj", "rosbags")
"""Whose versions a reader may ask for."""


def run_of(
    result: Result, sessions: Iterable[Sought], settings: Overrides, out: Path, figures: Iterable[Metric]
) -> Run:
    """All that a report tells of a run whose map lies in `out`."""
    content = json.loads((out / MAP_FILE).read_text())
    return Run(
        stages=stage_times(result),
        settings=changed_settings(settings, {s.name: s.input.settings for s in sessions}),
        facts=_facts(content, figures),
        logs=[Log(s["name"], s["log"], s["scans"], s["start_ns"], s["end_ns"]) for s in content["sessions"]],
        files=[File(MAP_FILE, *_digest(out / MAP_FILE)), *_files(content)],
    )


def stage_times(result: Result) -> list[StageTime]:
    """One row per stage that had tasks, in the order of the workflow."""
    rows = {node.name: StageTime(node.name) for node in NODES}
    for task in result.tasks:
        rows[task.node] = rows[task.node].plus(task.verdict == "RUN", task.wall_s, task.peak_rss_mb)
    return [row for row in rows.values() if row.tasks]


def changed_settings(
    settings: Overrides, of_sessions: Mapping[str, Mapping[str, Mapping[str, Any]]]
) -> list[Changed]:
    """Settings whose value is not the default, of the whole run, then of single sessions."""
    rows = list(_differing("", settings))
    for name, own in of_sessions.items():
        rows += _differing(name, own)
    return rows


def _differing(session: str, layer: Mapping[str, Mapping[str, Any]]) -> Iterable[Changed]:
    for name, model in resolve(NODES, [("settings", layer)]).items():
        for field in layer.get(name, {}):
            value, default = (
                getattr(model, field),
                type(model).model_fields[field].get_default(call_default_factory=True),
            )
            if value != default:
                doc = type(model).model_fields[field].description or ""
                yield Changed(f"{name}.{field}", _text(value), _text(default), session, doc)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _facts(content: Mapping[str, Any], figures: Iterable[Metric]) -> dict[str, str]:
    by_name = {row["name"]: row["value"] for row in figures}
    parent = content.get("parent")
    facts = {
        "made": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
        "map": f"{content['name']}, version {content['version']}",
        "extends": f"{parent['name']}, version {parent['version']}" if parent else "",
        "wall time": f"{by_name.get('run.wall_s', 0):.1f} s for {by_name.get('run.log_s', 0):.1f} s of log",
        "real-time factor": f"{by_name.get('run.realtime_factor', 0):.2f}",
        "peak memory": f"{by_name.get('run.peak_rss_mb', 0):.0f} MB, all processes together",
        "scanloom": metadata.version("scanloom"),
        "commit": git_commit(),
        "python": platform.python_version(),
        "libraries": ", ".join(f"{name} {_version(name)}" for name in LIBRARIES),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
    return {key: value for key, value in facts.items() if value}


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"


def _files(content: Mapping[str, Any]) -> list[File]:
    return [File(name, row["sha256"], row["bytes"]) for name, row in sorted(content["files"].items())]


def _digest(path: Path) -> tuple[str, int]:
    body = path.read_bytes()
    return hashlib.sha256(body).hexdigest(), len(body)
