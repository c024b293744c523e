"""Report: the parts of `report.html` that do not vary from run to run."""

from __future__ import annotations

import base64

from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.evaluation import ErrorTrack, Metrics, PictureFiles, ReportFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.product import Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import TileIndex
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses
from scanloom.stages.report.charts import Curve, line_chart
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.gnss_agreement import gnss_agreements
from scanloom.stages.report.map_picture import OVERLAY, PLAIN
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
    poses: Parts[Poses],
    loops: Loops,
    tile_index: TileIndex,
    picture: PictureFiles,
    gnss: Parts[Gnss],
    check: Parts[SensorCheck] | None = None,
) -> ReportFiles:
    """Judge the map and write the body of the report, to be wrapped by `page.compose`."""
    sessions = {c["session"]: s for c, s in session.items()}
    paths = {c["session"]: p for c, p in poses.items()}
    figures = Figures(metrics)
    agreements = gnss_agreements(sessions, paths, gnss)
    verdict = judge(_limits(settings), sessions, figures, {n: a.median_m for n, a in agreements.items()})
    body = render(
        "body.html",
        verdict=verdict,
        cards=headline_cards(sessions, figures),
        picture=_data_uri(picture.read(PLAIN)),
        overlay=picture.read(OVERLAY).decode(),
        names=list(paths),
        loops=loops,
        has_fixes=any(len(a.fixes) for a in agreements.values()),
        charts=_charts(error_track),
        tables=metric_tables(sessions, figures),
        sessions=sessions,
        checks={c["session"]: found for c, found in check.items()} if check is not None else {},
        tiles=tile_index,
        tile_rows=tile_rows(tile_index),
        georeference=tile_index.georeference,
    )
    return ReportFiles(contents={"body.html": body.encode()})


def _limits(settings: Settings) -> Limits:
    return Limits(
        settings.unreliable_warn, settings.unreliable_fail, settings.gnss_warn_m, settings.gnss_fail_m,
        settings.ate_warn_m, settings.drift_warn_percent, settings.open_path_warn_m,
    )  # fmt: skip


def _charts(error_track: Parts[ErrorTrack]) -> dict[str, str]:
    charts = {}
    for coordinate, track in error_track.items():
        curves = [
            Curve(
                "odometry, laid over truth at the first scan", track.travelled_m, track.odometry_error_m, 2
            ),
            Curve("map, aligned as a whole", track.travelled_m, track.fusion_error_m, 1),
        ]
        charts[coordinate["session"]] = line_chart(curves, "distance driven, m", "distance to truth, m")
    return charts


def _data_uri(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()
