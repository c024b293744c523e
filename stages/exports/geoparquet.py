"""Trajectories as GeoParquet 1.1: a row per scan with position, rotation, time and how sure the position is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.wgs84 import places
from scanloom.stages.geometry.se3 import F8, quaternion_from_matrix

VERSION = "1.1.0"
WKB_POINT_Z = 1001
"""ISO code of a point with a third coordinate."""


def write_geoparquet(source: MapSource, folder: Path, options: Options) -> list[Path]:
    """`trajectory.parquet`; a row group per session, positions as WKB points with z in the projected system.

    What heights are counted from stands in the footer under `heights`.
    A map without georeference keeps its own coordinates, and the file says that they are of no known system
    (`"crs": null`).

    Raises
    ------
    UsageError : the system asked for is not known, or its grid is not installed.
    """
    import pyarrow.parquet as pq

    projector = Projector.of(source, options)
    crs = None if projector.plain_crs is None else projector.plain_crs.to_json_dict()
    sessions = {
        name: (poses, projector.project(places(poses))) for name, poses in source.trajectories().items()
    }
    positions = np.vstack([np.empty((0, 3)), *(p for _, p in sessions.values())])
    path = folder / "trajectory.parquet"
    schema = _schema(_metadata(positions, crs), projector.heights)
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        for name, (poses, at) in sessions.items():
            writer.write_table(_table(name, poses, at, schema))
    return [path]


def _metadata(positions: F8, crs: dict[str, Any] | None) -> dict[str, Any]:
    """Content of the footer's key `geo`."""
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": ["Point Z"],
        "crs": crs,
        "edges": "planar",
    }
    if len(positions):
        column["bbox"] = [*positions.min(axis=0).tolist(), *positions.max(axis=0).tolist()]
    return {"version": VERSION, "primary_column": "geometry", "columns": {"geometry": column}}


def _schema(metadata: dict[str, Any], heights: str) -> Any:
    import pyarrow as pa

    numbers = [
        ("qw", "rotation from the LiDAR's axes to the map's, unit quaternion"),
        ("qx", ""),
        ("qy", ""),
        ("qz", ""),
        ("sigma_x_m", "standard deviation of the position along x of the map (east), m"),
        ("sigma_y_m", "along y of the map (north), m"),
        ("sigma_z_m", "upwards, m"),
        ("sigma_position_m", "root of the sum of the three variances, m"),
        ("sigma_heading_rad", "standard deviation of the rotation about the vertical, rad"),
    ]
    fields = [
        pa.field("session", pa.dictionary(pa.int32(), pa.string()), False),
        pa.field("scan_index", pa.int64(), False, {"doc": "number of the scan in its session"}),
        pa.field("stamp", pa.timestamp("ns", "UTC"), False, {"doc": "reference time of the scan"}),
        pa.field("geometry", pa.binary(), False, {"doc": f"position of the LiDAR; z is {heights}"}),
        *(pa.field(name, pa.float64(), False, {"doc": doc} if doc else None) for name, doc in numbers),
        pa.field("keyframe", pa.bool_(), False, {"doc": "a node of the pose graph; others are interpolated"}),
    ]
    return pa.schema(fields, {"geo": json.dumps(metadata), "heights": heights})


def _table(session: str, poses: Poses, positions: F8, schema: Any) -> Any:
    import pyarrow as pa

    q = quaternion_from_matrix(poses.T_world_lidar[:, :3, :3])
    sigma, sigma_heading = sigmas(poses)
    n = len(poses)
    columns = {
        "session": pa.DictionaryArray.from_arrays(pa.array(np.zeros(n, np.int32)), pa.array([session])),
        "scan_index": poses.scan_index,
        "stamp": pa.array(poses.stamp_ns).cast(pa.timestamp("ns", "UTC")),
        "geometry": pa.array(_wkb(positions), pa.binary()),
        **dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True)),
        **dict(zip(("sigma_x_m", "sigma_y_m", "sigma_z_m"), sigma.T, strict=True)),
        "sigma_position_m": np.linalg.norm(sigma, axis=1),
        "sigma_heading_rad": sigma_heading,
        "keyframe": poses.keyframe,
    }
    return pa.table([pa.array(columns[name]) for name in schema.names], schema=schema)


def sigmas(poses: Poses) -> tuple[F8, F8]:
    """Standard deviations of the position along the map's axes (n, 3), m, and of the heading (n,), rad.

    The covariance is that of a right tangent, in the LiDAR's axes: Sigma_map = R Sigma_lidar R^T for each 3 x 3 block.
    """
    R = poses.T_world_lidar[:, :3, :3]
    rotated = [R @ poses.covariance[:, at, at] @ R.swapaxes(1, 2) for at in (slice(3, 6), slice(0, 3))]
    position, rotation = (np.sqrt(np.maximum(np.einsum("nii->ni", block), 0.0)) for block in rotated)
    return position, rotation[:, 2]


def _wkb(positions: F8) -> list[bytes]:
    """Little-endian well-known binary of points (n, 3)."""
    points = np.zeros(len(positions), np.dtype([("order", "u1"), ("kind", "<u4"), ("xyz", "<f8", 3)]))
    points["order"], points["kind"], points["xyz"] = 1, WKB_POINT_Z, positions
    return [point.tobytes() for point in points]
