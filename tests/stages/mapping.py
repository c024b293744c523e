"""A small mapped street: every product that tiling, evaluation and report read, with exact truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Part, Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, PointClass, ScanLabels
from scanloom.schemas.session import Session
from scanloom.schemas.tiles import Piece, Tile, TileFiles
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp
from scanloom.stages.tiling import tiles, tiling
from scanloom.stages.tiling.pieces import Settings as TilingSettings
from scanloom.stages.tiling.tiles import Settings as TilesSettings
from tests.worlds import GROUND_Z_M

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000


def stamps(count: int) -> np.ndarray:
    return START_NS + PERIOD_NS * np.arange(count)


def circle(count: int = 1000, step_m: float = 1.0, radius_m: float = 80.0) -> F8:
    """A drive of `count` scans around a circle, two times for the defaults."""
    turn = pose(so3_exp([0, 0, step_m / radius_m]), [step_m, 0, 0])
    T = [np.eye(4)]
    for _ in range(count - 1):
        T.append(T[-1] @ turn)
    return np.array(T)


def drifting(
    T: F8, scale: float = 1.0, yaw_rate_rad_m: float = 0.0, seed: int = 0, noise_m: float = 0.0
) -> F8:
    """The same motion with a scale error, a constant yaw drift and white noise of each step."""
    rng = np.random.default_rng(seed)
    out = [T[0]]
    for step in inverse(T[:-1]) @ T[1:]:
        wrong = step.copy()
        wrong[:3, 3] = scale * step[:3, 3] + rng.normal(0, noise_m, 3)
        yaw = yaw_rate_rad_m * np.linalg.norm(step[:3, 3])
        out.append(out[-1] @ wrong @ pose(so3_exp([0, 0, yaw]), np.zeros(3)))
    return np.array(out)


def labels_of(scans: Sequence[DeskewedScan], T: F8) -> list[ScanLabels]:
    """Ground by height of the true point, everything else static."""
    labels = []
    for scan, T_map_lidar in zip(scans, T):
        z = scan.points() @ T_map_lidar[2, :3] + T_map_lidar[2, 3]
        classes = np.where(z < GROUND_Z_M + 0.15, PointClass.GROUND, PointClass.STATIC).astype(np.uint8)
        labels.append(ScanLabels(class_=classes, reference_ns=scan.reference_ns, scan_index=scan.scan_index))
    return labels


def poses_of(T: F8, *, georeference: dict[str, Any] | None = None) -> Poses:
    n = len(T)
    return Poses(
        scan_index=np.arange(n), stamp_ns=stamps(n), T_world_lidar=T, covariance=np.tile(np.eye(6) * 1e-4, (n, 1, 1)),
        keyframe=np.ones(n, bool), frame="world" if georeference else "map", georeference=georeference,
    )  # fmt: skip


def odometry_of(T: F8, *, reliable: np.ndarray | None = None) -> Odometry:
    n = len(T)
    one = np.ones(n)
    return Odometry(
        scan_index=np.arange(n), stamp_ns=stamps(n), T_odom_lidar=T, covariance=np.tile(np.eye(6) * 1e-4, (n, 1, 1)),
        inlier_ratio=one, rmse_m=one * 0.02, degeneracy_d=one, degeneracy_e=one * 0.01, direction_p=np.ones((n, 6)),
        weak_directions=np.tile(np.eye(6), (n, 1, 1)), keyframe=np.ones(n, bool),
        reliable=np.ones(n, bool) if reliable is None else reliable, segment=np.zeros(n, np.int32),
    )  # fmt: skip


def truth_of(T: F8) -> Truth:
    return Truth(stamp_ns=stamps(len(T)), T_truth_lidar=T, source="analytic")


def loops_of(T: F8, pairs: Sequence[tuple[int, int]], errors_m: Sequence[float], session: str = "a") -> Loops:
    """Accepted loops between scans of one session, each wrong by so many metres along x."""
    i, j = (np.array([pair[k] for pair in pairs], np.int64) for k in (0, 1))
    T_i_j = inverse(T[i]) @ T[j]
    T_i_j[:, 0, 3] += errors_m
    n = len(pairs)
    names = np.array([session] * n, object)
    return Loops(
        session_i=names, scan_i=i, session_j=names, scan_j=j, T_i_j=T_i_j, covariance=np.tile(np.eye(6), (n, 1, 1)),
        descriptor_distance=np.full(n, 0.1), inlier_ratio=np.full(n, 0.9), rmse_m=np.full(n, 0.05), overlap=np.full(n, 0.8),
        source=np.full(n, "position", object), temporal_distance=np.full(n, np.nan), segment_distance=np.full(n, np.nan),
        seen_through=np.zeros(n), e1_m=np.zeros(n), rival=np.zeros(n),
        accepted=np.ones(n, bool), reason=np.array(["verified"] * n, object),
    )  # fmt: skip


def graph_of(loops: Loops, verdicts: Sequence[str] | None = None, remarks: Sequence[str] = ()) -> Graph:
    """The pose graph that took in the accepted loops; used unless told otherwise."""
    rows = np.flatnonzero(loops.accepted)
    n = len(rows)
    return Graph(
        kind=np.full(n, "loop", object),
        key_i=np.array([f"{loops.session_i[k]}/{loops.scan_i[k]}" for k in rows], object),
        key_j=np.array([f"{loops.session_j[k]}/{loops.scan_j[k]}" for k in rows], object),
        measurement=loops.T_i_j[rows], covariance=loops.covariance[rows], residual_before=np.full(n, 2.0),
        residual_after=np.ones(n), residual_m=np.full((n, 3), np.nan),
        weight=np.array([1.0 if v == "used" else 0.0 for v in verdicts or ["used"] * n]),
        verdict=np.array(verdicts or ["used"] * n, object), remarks=remarks,
    )  # fmt: skip


def fixes_graph(positions: F8, residual_m: F8, verdicts: Sequence[str], session: str = "a") -> Graph:
    """One factor per fix on the scan of the same number."""
    n = len(positions)
    measurement = np.tile(np.eye(4), (n, 1, 1))
    measurement[:, :3, 3] = positions
    return Graph(
        kind=np.full(n, "gnss", object), key_i=np.array([f"{session}/{k}" for k in range(n)], object),
        key_j=np.full(n, "", object), measurement=measurement, covariance=np.tile(np.eye(6), (n, 1, 1)),
        residual_before=np.full(n, 2.0), residual_after=np.ones(n), residual_m=residual_m,
        weight=np.array([float(v == "used") for v in verdicts]), verdict=np.array(verdicts, object),
    )  # fmt: skip


def session_of(name: str = "a", scans: int = 10, **changes: Any) -> Session:
    fields: dict[str, Any] = {
        "name": name, "format": "mcap", "start_ns": START_NS, "end_ns": START_NS + scans * PERIOD_NS, "scan_count": scans,
        "point_count": scans * 1000, "scan_rate_hz": 10.0, "beams": 16, "point_time": "per point", "topics": (),
        "extrinsics": (), "problems": (), "complete": True,
    }  # fmt: skip
    return Session(**{**fields, **changes})


def one(product: Any, session: str = "a") -> Parts[Any]:
    """A product of one session, as a map stage gets it."""
    return Parts([((("session", session),), product)])


def pieces_of(
    scans: Sequence[DeskewedScan], T: F8, settings: TilingSettings | None = None, poses: Poses | None = None
) -> list[Part[Piece]]:
    labels = FinalLabels(labels_of(scans, T))
    return list(tiling(settings or TilingSettings(), Deskewed(scans), labels, poses or poses_of(T)))


@dataclass(frozen=True)
class Source:
    """Pieces of one chunk of a session."""

    session: str
    chunk: str
    pieces: list[Part[Piece]]


def tiles_of(
    sources: Sequence[Source], settings: TilesSettings | None = None
) -> dict[str, tuple[Tile, TileFiles]]:
    """Merge the pieces tile by tile, as the engine does."""
    found: dict[str, list[Any]] = {}
    for source in sources:
        for part in source.pieces:
            where = (("session", source.session), ("chunk", source.chunk), ("tile", part.key))
            found.setdefault(part.key, []).append((where, part.product))
    made = {name: tiles(settings or TilesSettings(), Parts(parts)) for name, parts in sorted(found.items())}
    return {name: (tile, files) for name, (tile, _, files) in made.items()}


def tile_parts(made: dict[str, tuple[Tile, TileFiles]]) -> Parts[Tile]:
    return Parts([((("tile", name),), tile) for name, (tile, _) in made.items()])
