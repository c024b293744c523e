"""Rows for the report's tables and the large figures on its top."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from scanloom.schemas.session import Session
from scanloom.schemas.tiles import TileIndex
from scanloom.stages.report.figures import Figures, Pair, Row, number

Card = tuple[str, str, str]


def headline_cards(sessions: dict[str, Session], figures: Figures) -> list[Card]:
    """The few figures everybody asks for first: (value, unit, label); those not computed are left out."""
    scans = sum(figures.get("odometry.scans", name) or 0.0 for name in sessions)
    path_m = sum(figures.get("fusion.path_length_m", name) or 0.0 for name in sessions)
    cards: list[Card] = [
        (number(scans), "", "scans mapped"),
        _length(path_m),
        _millions(figures.get("map.points") or 0.0),
        (number(figures.get("map.area_m2") or 0.0), "m²", "area covered"),
        (number(figures.get("loops.accepted") or 0.0), "", "loops closed"),
    ]
    ate = [value for name in sessions if (value := figures.get("fusion.ate_rmse_m", name)) is not None]
    if ate:
        cards.append((f"{max(ate):.2f}", "m", "error against truth (ATE)"))
    drift = [
        value for name in sessions if (value := figures.get("odometry.kitti_t_rel_percent", name)) is not None
    ]
    if drift:
        cards.append((f"{max(drift):.2f}", "%", "odometry drift (t_rel)"))
    entropy = figures.get("map.mme_r0.5_nat")
    if entropy is not None:
        cards.append((f"{entropy:.2f}".replace("-", "−"), "nat", "mean map entropy, r = 0.5 m"))
    return cards


@dataclass(frozen=True)
class MetricTable:
    """Metrics of a session or of the map, with truth or without: those of odometry beside the map's, and the rest."""

    title: str
    pairs: list[Pair]
    rows: list[Row]


def metric_tables(sessions: dict[str, Session], figures: Figures) -> list[MetricTable]:
    """Tables per session and of the map, what was held against truth apart from what needs none; empty ones are left out."""
    tables = []
    for title, session in (*((f"Session {name}", name) for name in sessions), ("Map", "")):
        pairs = figures.pairs(session) if session else []
        rows = figures.single(session)
        for truth, about in ((True, "against truth"), (False, "without truth")):
            tables.append(
                MetricTable(
                    f"{title}, {about}",
                    [pair for pair in pairs if pair.any.truth == truth],
                    [row for row in rows if row.truth == truth],
                )
            )
    return [table for table in tables if table.pairs or table.rows]


def tile_rows(index: TileIndex) -> list[dict[str, Any]]:
    """One row per tile with its bounds; the checksum is that of the finest level."""
    return [
        {
            "tile": name,
            "points": int(index.points[rows].sum()),
            "ranges": list(
                zip(index.min_m[rows].min(axis=0).tolist(), index.max_m[rows].max(axis=0).tolist())
            ),
            "sessions": index.sessions[rows][-1],
            "checksum": index.checksum[rows][-1],
        }
        for name, rows in index.by_tile().items()
    ]


def _length(path_m: float) -> Card:
    if path_m >= 1000:
        return f"{path_m / 1000:.2f}", "km", "driven"
    return f"{path_m:.1f}", "m", "driven"


def _millions(points: float) -> Card:
    if points >= 1e6:
        return f"{points / 1e6:.2f}", "million", "points in the map"
    return number(points), "", "points in the map"
