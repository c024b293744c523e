"""Report: the parts of `report.html` that do not vary from run to run, and the preview picture."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.evaluation import ErrorTrack, Metrics, ReportFiles
from scanloom.schemas.loops import Loops
from scanloom.schemas.product import Parts
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import Tile, TileIndex
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses
from scanloom.stages.report.charts import Curve, line_chart
from scanloom.stages.report.figures import Figures
from scanloom.stages.report.gnss_agreement import Agreement, gnss_agreement
from scanloom.stages.report.marks import map_marks
from scanloom.stages.report.overlay import Mark, paint, scale_bar, to_svg
from scanloom.stages.report.picture import View, draw_map, fit_view
from scanloom.stages.report.tables import headline_cards, metric_tables, tile_rows
from scanloom.stages.report.templates import render
from scanloom.stages.report.verdict import Limits, judge

VERSION = 1


class Settings(BaseModel):
    """The picture, and from which values on the verdict warns."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    picture_px: int = Field(1600, ge=200, le=8000, description="longer side of the map's picture, pixels")
    margin_m: float = Field(
        40.0, ge=0.0, le=1000.0, description="what the picture shows around the trajectory, m"
    )
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


@dataclass(frozen=True)
class MapPicture:
    """The picture without and with marks, and the marks as SVG."""

    plain: Image.Image
    marked: Image.Image
    overlay: str


def report(
    settings: Settings,
    session: Parts[Session],
    metrics: Metrics,
    error_track: Parts[ErrorTrack],
    poses: Parts[Poses],
    loops: Loops,
    tile_index: TileIndex,
    tiles: Parts[Tile],
    gnss: Parts[Gnss],
    check: Parts[SensorCheck] | None = None,
) -> ReportFiles:
    """Judge the map, draw it, and write the body of the report.

    `body.html` is to be wrapped by `page.compose`; `preview.png` shows the map from above.
    """
    sessions = {c["session"]: s for c, s in session.items()}
    paths = {c["session"]: p for c, p in poses.items()}
    figures = Figures(metrics)
    agreements = _agreements(sessions, paths, gnss)
    verdict = judge(_limits(settings), sessions, figures, {n: a.median_m for n, a in agreements.items()})
    picture = _picture(settings, paths, loops, tile_index, tiles, agreements)
    body = render(
        "body.html",
        verdict=verdict,
        cards=headline_cards(sessions, figures),
        picture=_data_uri(picture.plain),
        overlay=picture.overlay,
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
    return ReportFiles(contents={"preview.png": _png(picture.marked), "body.html": body.encode()})


def _limits(settings: Settings) -> Limits:
    return Limits(
        settings.unreliable_warn, settings.unreliable_fail, settings.gnss_warn_m, settings.gnss_fail_m,
        settings.ate_warn_m, settings.drift_warn_percent, settings.open_path_warn_m,
    )  # fmt: skip


def _agreements(
    sessions: dict[str, Session], paths: dict[str, Poses], gnss: Parts[Gnss]
) -> dict[str, Agreement]:
    fixes = {c["session"]: g for c, g in gnss.items()}
    return {name: gnss_agreement(fixes[name], paths[name], sessions[name]) for name in paths if name in fixes}


def _picture(
    settings: Settings,
    paths: dict[str, Poses],
    loops: Loops,
    index: TileIndex,
    tiles: Parts[Tile],
    agreements: dict[str, Agreement],
) -> MapPicture:
    view = _view(settings, paths, index)
    plain, view = _enlarge(draw_map(tiles, view), view, settings.picture_px)
    fixes = {name: agreement.fixes for name, agreement in agreements.items()}
    marks: list[Mark] = map_marks(view, paths, loops, fixes) + scale_bar(view)
    return MapPicture(Image.fromarray(plain), paint(plain, marks), to_svg(marks, view))


def _enlarge(picture: NDArray[np.uint8], view: View, longest: int) -> tuple[NDArray[np.uint8], View]:
    """A small map with larger pixels, so that lines and letters on it are sharp."""
    factor = max(longest // max(view.width, view.height), 1)
    enlarged = view.enlarged(factor)
    image = Image.fromarray(picture).resize((enlarged.width, enlarged.height), Image.Resampling.BICUBIC)
    return np.asarray(image), enlarged


def _view(settings: Settings, paths: dict[str, Poses], index: TileIndex) -> View:
    """Around the trajectories; without any, around the tiles."""
    driven = [p.T_world_lidar[:, :2, 3] for p in paths.values() if len(p)]
    corners = np.concatenate(driven) if driven else np.concatenate((index.min_m, index.max_m))[:, :2]
    if len(corners) == 0:
        corners = np.zeros((1, 2))
    finest_m = 1.25 * index.voxel_size_m
    return fit_view(
        corners.min(axis=0), corners.max(axis=0), settings.margin_m, settings.picture_px, finest_m
    )


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


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", compress_level=3)
    return buffer.getvalue()


def _data_uri(image: Image.Image) -> str:
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
