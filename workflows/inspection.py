"""`inspect` for people: what is in a log, as text."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from scanloom.pipeline.settings import resolve
from scanloom.schemas.errors import EXIT_INVALID_INPUT, EXIT_OK
from scanloom.stages.images import Settings as ImageSettings
from scanloom.stages.ingest import Settings
from scanloom.stages.logs.inspection import InspectedCamera, Inspection, inspect_log
from scanloom.workflows.configuration import Overrides
from scanloom.workflows.map_session import NODES

READING = ("ingest", "images")
"""Stages that read the log."""
MARKS = {"error": "ERROR", "warning": "warn ", "info": "note "}


def inspection_of(session: str, overrides: Overrides) -> Inspection:
    """Look at a log without computing anything.

    Raises
    ------
    InvalidInput : it is no log at all.
    UsageError : a setting is wrong.
    """
    settings = resolve(tuple(n for n in NODES if n.name in READING), [("--set", overrides)])
    ingest, images = (settings[name] for name in READING)
    return inspect_log(
        Path(session),
        ingest if isinstance(ingest, Settings) else None,
        images if isinstance(images, ImageSettings) else None,
    )


def exit_code_of(found: Inspection) -> int:
    """4 when `map` would refuse it."""
    return EXIT_OK if found.usable else EXIT_INVALID_INPUT


def text_of(found: Inspection) -> str:
    """A screen of text."""
    lines = [
        f"{found.path}: {found.format}, {found.size_bytes / 1e6:.1f} MB in {found.files} file{'s' * (found.files != 1)}, "
        f"{found.duration_s:.1f} s{_when(found)}",
        "",
        f"  {'topic':34} {'type':34} {'messages':>8} {'rate':>9}  used as",
    ]
    lines += [_topic_line(topic) for topic in found.topics]
    lines += ["", _scans_line(found)]
    lines += [f"extrinsics of {e.sensor}: {e.source}" for e in found.extrinsics]
    lines += [_camera_line(camera) for camera in found.cameras]
    if found.missing:
        lines.append(f"not in this log: {', '.join(found.missing)}")
    if found.truth:
        lines.append(f"truth, for evaluation only: {len(found.truth)} file{'s' * (len(found.truth) != 1)}")
    lines += [f"{MARKS[p.severity]} {p.text}" for p in found.problems]
    lines += ["", f"{'can be mapped' if found.usable else 'CANNOT be mapped'}. Next: {found.next_step}"]
    return "\n".join(lines)


def _when(found: Inspection) -> str:
    if not found.start_ns:
        return ""
    return time.strftime(", from %Y-%m-%d %H:%M:%S UTC", time.gmtime(found.start_ns // 1_000_000_000))


def _topic_line(topic: Any) -> str:
    used = "" if topic.role == "unused" else topic.role
    remark = f"  ({topic.remark})" if topic.remark else ""
    return f"  {topic.name:34} {topic.type:34} {topic.messages:8} {topic.rate_hz:6.1f} Hz  {used}{remark}"


def _camera_line(camera: InspectedCamera) -> str:
    size = f" of {camera.width_px} x {camera.height_px} px" if camera.width_px else ""
    if not camera.lens:
        known = "not calibrated, not used"
    else:
        place = "" if camera.mounted else ", place on the LiDAR unknown"
        known = f"{camera.lens} ({camera.source}){place}"
    return f"camera {camera.name}: {camera.images} images{size} on {camera.topic}; {known}"


def _scans_line(found: Inspection) -> str:
    if not found.scans:
        return "no 3D LiDAR scans"
    beams = f", {found.beams} beams" if found.beams else ""
    return (
        f"{found.scans} scans of about {found.points_per_scan} points{beams}; point time: {found.point_time}"
    )
