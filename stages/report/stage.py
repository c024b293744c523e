"""Report: the parts of `report.html` that do not vary from run to run.

A verdict with every check behind it; the map from above, with what was left out of it to be shown or hidden; errors along the way; the loop graph with what was refused and
why; GNSS residuals by verdict; where odometry was blind, and in which direction; the pose graph kind by kind; for an
extended map what is no longer there; all figures; the input and what is odd about it; the tiles.
"""

from __future__ import annotations

import base64

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.changes import Changes
from scanloom.schemas.evaluation import ErrorTrack, Metrics, PictureFiles, ReportFiles
from scanloom.schemas.loops import Loops
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
from scanloom.stages.report.left_out import out_rows
from scanloom.stages.report.loop_graph import loop_graph
from scanloom.stages.report.map_picture import LEFT_OUT, OVERLAY, PLAIN
from scanloom.stages.report.tables import headline_cards, metric_tables, tile_rows
from scanloom.stages.report.templates import render
from scanloom.stages.report.verdict import Limits, judge

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
) -> ReportFiles:
    """Judge the map and write the body of the report, to be wrapped by `page.compose`."""
    sessions, paths = by_session(session), by_session(poses)
    fixes = {name: rows for name, rows in fix_rows(graph).items() if name in paths}
    figures = Figures(metrics)
    joined = loop_graph(paths, loops, graph)
    body = render(
        "body.html",
        verdict=judge(_limits(settings), sessions, figures, _gnss_medians(paths, fixes), graph),
        cards=headline_cards(sessions, figures),
        picture=_data_uri(picture.read(PLAIN), "jpeg"),
        left_out=_data_uri(picture.read(LEFT_OUT), "png"),
        out_rows=out_rows(list(sessions), figures),
        overlay=picture.read(OVERLAY).decode(),
        names=list(paths),
        has_fixes=tile_index.georeference is not None and any(len(rows) for rows in fixes.values()),
        loops=joined,
        charts={name: error_chart(track) for name, track in by_session(error_track).items()},
        fixes={name: fix_track(rows, paths[name]) for name, rows in fixes.items()},
        blind=blind_sessions(sessions, by_session(odometry)),
        factors=factor_rows(graph),
        gone=changed(paths, changes),
        tables=metric_tables(sessions, figures),
        sessions=sessions,
        checks=by_session(check),
        tiles=tile_index,
        tile_rows=tile_rows(tile_index),
        georeference=tile_index.georeference,
    )
    return ReportFiles(contents={"body.html": body.encode()})


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
    )  # fmt: skip


def _data_uri(image: bytes, kind: str) -> str:
    return f"data:image/{kind};base64," + base64.b64encode(image).decode()
