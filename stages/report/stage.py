"""Report: the parts of `report.html` that do not vary from run to run.

A verdict in a sentence with every check behind it; the input and what is odd about it; the map from above by height,
intensity, class or colour, with what was left out of it to be shown or hidden; the tracks coloured by what is known of each scan;
errors along the way; where odometry was blind, and in which direction; GNSS residuals by verdict; loops with what was
refused and why; what moved and how much of each scan was left out; for an extended map what is no longer there; the pose
graph kind by kind; all figures; the tiles.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.cameras import CameraCheck, Cameras
from scanloom.schemas.changes import Changes
from scanloom.schemas.clean import ClassCounts
from scanloom.schemas.evaluation import ErrorTrack, Metrics, PictureFiles, ReportFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Parts, ProductT
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import TileIndex
from scanloom.schemas.trajectory import Odometry, Poses
from scanloom.stages.geometry.factor_rows import FixRows, fix_rows
from scanloom.stages.report.along import blind_sessions, error_chart, fix_track
from scanloom.stages.report.changed import changed
from scanloom.stages.report.factor_table import factor_rows
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.known import Known, quantities
from scanloom.stages.report.left_out import out_rows
from scanloom.stages.report.loop_graph import loop_graph
from scanloom.stages.report.map_picture import LAYERS, LEFT_OUT, OVERLAY, VIEW
from scanloom.stages.report.moving import moving, share_chart
from scanloom.stages.report.plan import track_plan
from scanloom.stages.report.sentence import evidence, sentence
from scanloom.stages.report.tables import headline_cards, metric_tables, tile_rows
from scanloom.stages.report.templates import render
from scanloom.stages.report.verdict import Limits, judge
from scanloom.stages.report.ways import Way, ways

VERSION = 1


class Settings(BaseModel):
    """From which values on the verdict warns."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    unreliable_warn: float = Field(
        0.01, ge=0.0, le=1.0, description="share of bridged scans that is worth a warning"
    )
    unreliable_fail: float = Field(
        0.1, ge=0.0, le=1.0, description="share of bridged scans that spoils the map"
    )
    gnss_warn_m: float = Field(2.0, gt=0.0, description="median distance of poses to GNSS worth a warning, m")
    gnss_fail_m: float = Field(
        10.0, gt=0.0, description="median distance of poses to GNSS that spoils the map, m"
    )
    ate_warn_m: float = Field(
        1.0, gt=0.0, description="error against truth worth a warning; ten times it fails, m"
    )
    open_path_warn_m: float = Field(
        500.0, ge=0.0, description="path without GNSS and without loops worth a warning, m"
    )
    drift_warn_percent: float = Field(
        2.0, gt=0.0, description="odometry drift worth a warning; five times it fails, %"
    )
    double_warn: float = Field(
        0.05, ge=0.0, le=1.0, description="share of walls that look double worth a warning"
    )
    double_fail: float = Field(
        0.3, ge=0.0, le=1.0, description="share of walls that look double that spoils the map"
    )


def report(
    settings: Settings,
    session: Parts[Session],
    metrics: Metrics,
    error_track: Parts[ErrorTrack],
    odometry: Parts[Odometry],
    poses: Parts[Poses],
    loops: Loops,
    graph: Graph,
    tile_index: TileIndex,
    picture: PictureFiles,
    check: Parts[SensorCheck] | None = None,
    changes: Changes | None = None,
    objects: Parts[ObjectTracks] | None = None,
    counts: Parts[ClassCounts] | None = None,
    cameras: Parts[Cameras] | None = None,
    camera_check: Parts[CameraCheck] | None = None,
) -> ReportFiles:
    """Judge the map and write the body of the report, to be wrapped by `page.compose`."""
    sessions, paths, odometries = by_session(session), by_session(poses), by_session(odometry)
    fixes = {name: rows for name, rows in fix_rows(graph).items() if name in paths}
    classes = _class_counts(counts)
    known = Known(paths, odometries, by_session(error_track), fixes, classes)
    on_way = ways(paths, odometries)
    figures = Figures(metrics)
    medians = _gnss_medians(paths, fixes)
    verdict = judge(_limits(settings), sessions, figures, medians, graph)
    body = render(
        "body.html",
        verdict=verdict,
        sentence=sentence(verdict, evidence(list(sessions), figures, list(medians.values()))),
        cards=headline_cards(sessions, figures),
        sessions=sessions,
        checks=by_session(check),
        cameras=by_session(cameras),
        agreements=by_session(camera_check),
        names=list(paths),
        **_pictures(picture),
        out_rows=out_rows(list(sessions), figures),
        has_fixes=tile_index.georeference is not None and any(len(rows) for rows in fixes.values()),
        tracks=track_plan(on_way, quantities(on_way, known), []),
        **_along_the_way(known, sessions, on_way),
        loops=loop_graph(paths, on_way, loops, graph),
        moving=moving(by_session(objects), paths, on_way),
        gone=changed(on_way, changes),
        factors=factor_rows(graph),
        tables=metric_tables(sessions, figures),
        tiles=tile_index,
        tile_rows=tile_rows(tile_index),
        georeference=tile_index.georeference,
    )
    return ReportFiles(contents={"body.html": body.encode()})


def _pictures(picture: PictureFiles) -> dict[str, Any]:
    """The map's pictures as they stand in the page."""
    return {
        "layers": {
            name: _data_uri(picture.read(file), "webp")
            for name, file in LAYERS.items()
            if file in picture.names or file in picture.contents
        },
        "left_out": _data_uri(picture.read(LEFT_OUT), "png"),
        "overlay": picture.read(OVERLAY).decode(),
        "view": json.loads(picture.read(VIEW)),
    }


def _along_the_way(
    known: Known, sessions: Mapping[str, Session], on_way: Mapping[str, Way]
) -> dict[str, dict[str, Any]]:
    """Figures over the distance driven, by section and session."""
    errors = {
        name: error_chart(name, track, on_way[name]) for name, track in known.errors.items() if name in on_way
    }
    shares = {
        name: share_chart(name, rows, on_way[name]) for name, rows in known.counts.items() if name in on_way
    }
    fixes = {
        name: fix_track(name, rows, on_way[name], known.poses[name].georeference is not None)
        for name, rows in known.fixes.items()
        if name in on_way
    }
    return {
        "charts": {name: plot for name, plot in errors.items() if plot},
        "shares": {name: plot for name, plot in shares.items() if plot},
        "fixes": fixes,
        "blind": blind_sessions(sessions, known.odometry, on_way),
    }


def _class_counts(counts: Parts[ClassCounts] | None) -> dict[str, ClassCounts]:
    """Of each session, its chunks in order."""
    if counts is None:
        return {}
    return {name: ClassCounts.concatenate(list(chunks)) for name, chunks in counts.by("session").items()}


def by_session(parts: Parts[ProductT] | None) -> dict[str, ProductT]:
    """Products by the name of their session."""
    return {} if parts is None else {where["session"]: product for where, product in parts.items()}


def _gnss_medians(paths: dict[str, Poses], fixes: dict[str, FixRows]) -> dict[str, float]:
    """Median horizontal distance of the fixes to the antenna, of sessions with a georeference, m."""
    distances = {
        name: rows.horizontal_m[np.isfinite(rows.horizontal_m)]
        for name, rows in fixes.items()
        if paths[name].georeference is not None
    }
    return {name: float(np.median(found)) for name, found in distances.items() if len(found)}


def _limits(settings: Settings) -> Limits:
    return Limits(
        settings.unreliable_warn, settings.unreliable_fail, settings.gnss_warn_m, settings.gnss_fail_m,
        settings.ate_warn_m, settings.drift_warn_percent, settings.open_path_warn_m,
        settings.double_warn, settings.double_fail,
    )  # fmt: skip


def _data_uri(image: bytes, kind: str) -> str:
    return f"data:image/{kind};base64," + base64.b64encode(image).decode()
