"""A small map with everything the viewer shows, and a server of it."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from scanloom.schemas.loops import Loops
from scanloom.schemas.objects import ObjectClass, ObjectTracks
from scanloom.schemas.product import FOOTER_KEY, columns_of
from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import RemovedTile, TileIndex
from scanloom.stages.exports.glb import VERTEX
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import pose
from scanloom.workflows.viewer.answers import Answers
from scanloom.workflows.viewer.server import Server
from tests.delivered import cut, write_map
from tests.stages.exports.tracks import poses_along

ORIGIN = georeference(48.2, 11.6, 515.0)
POINTS = 30_000
SCANS = 40
INTENSITIES = np.linspace(0, 60, POINTS).astype(np.float32)
"""Of each point its own: they tell which is which."""
FIRST_NS = 1_760_000_000_000_000_000
PLY = b"""ply
format binary_little_endian 1.0
comment scanloom points left out of the map
element vertex %d
property float x
property float y
property float z
property float intensity
property uchar class
end_header
"""


def scene() -> np.ndarray:
    """Points (n, 3): ground and a wall."""
    rng = np.random.default_rng(11)
    ground = np.column_stack((rng.uniform(-30, 30, (POINTS - 5_000, 2)), rng.normal(0, 0.02, POINTS - 5_000)))
    wall = np.column_stack((rng.uniform(-20, 20, 5_000), np.full(5_000, 12.0), rng.uniform(0, 8, 5_000)))
    return np.concatenate((ground, wall)).astype(np.float32).astype(float)


def make_map(folder: Path, *, removed: int = 0) -> None:
    """A map of the scene with a drive past the wall, one loop and one car."""
    columns = {
        "intensity": INTENSITIES,
        "class_": np.where(np.arange(POINTS) < POINTS - 5_000, PointClass.GROUND, PointClass.STATIC).astype(
            np.uint8
        ),
        "first_ns": np.arange(POINTS, dtype=np.int64) + FIRST_NS,
    }
    tiles = cut(scene(), columns=columns, georeference=ORIGIN.model_dump(), sessions=("drive",))
    write_map(folder, tiles, name="Old town")
    along = np.column_stack((np.linspace(-25, 25, SCANS), np.zeros(SCANS), np.full(SCANS, 1.7)))
    poses_along(along, ORIGIN, yaw_rad=0.0).write(folder / "trajectory.parquet")
    _loops().write(folder / "loops.parquet")
    _car().write(folder / "objects.parquet")
    (folder / "removed.ply").write_bytes(_removed(removed))
    _removed_tiles(removed, folder / "removed")


def removed_places(count: int) -> np.ndarray:
    """Points (n, 3) that were left out, tile after tile."""
    places = np.random.default_rng(12).uniform(-30, 30, (count, 3)) * (1, 1, 0.02)
    return places[np.lexsort(np.floor(places[:, 1::-1] / 50.0).T)].astype(np.float32).astype(float)


def _removed(count: int) -> bytes:
    rows = np.zeros(count, np.dtype([("p", "<f4", 3), ("intensity", "<f4"), ("class", "u1")]))
    rows["p"] = removed_places(count)
    rows["class"] = PointClass.DYNAMIC
    return PLY % count + rows.tobytes()


def _removed_tiles(count: int, folder: Path) -> None:
    """The same points with all that is known of them; stamps are their numbers."""
    folder.mkdir()
    columns = {
        "class_": np.full(count, PointClass.DYNAMIC, np.uint8),
        "first_ns": np.arange(count, dtype=np.int64) + FIRST_NS,
    }
    for name, tile in cut(removed_places(count), columns=columns, sessions=("drive",)).items():
        fields = {key: getattr(tile, key) for key in columns_of(RemovedTile)}
        RemovedTile(**fields, **tile.attributes).write(folder / f"{name}.parquet")


def paint(folder: Path) -> None:
    """Colours for what lies east of the middle, in the columns that cameras fill: red grows with x, blue is full."""
    names = TileIndex.open(folder / "tiles" / "index.parquet").names
    across = np.array([float(name.split("_")[0]) for name in names]) * 50.0
    for path in (folder / "tiles").glob("*.parquet"):
        if path.stem == "index":
            continue
        table = pq.read_table(path)
        tile = table["tile"].to_numpy() if path.stem == "overview" else names.index(path.stem)
        x_m = table["x_m"].to_numpy() + across[tile]
        rgb = np.column_stack((np.clip(x_m * 8.0, 1, 255), np.zeros(len(x_m)), np.full(len(x_m), 255)))
        rgb = np.where(x_m[:, None] > 0.0, rgb, 0).astype(np.uint8)
        field = table.schema.field("colour").type
        assert str(field) == "fixed_size_binary[3]"
        colour = pa.FixedSizeBinaryArray.from_buffers(field, len(rgb), [None, pa.py_buffer(rgb.tobytes())])
        painted = table.set_column(table.schema.get_field_index("colour"), "colour", colour)
        views = pa.array((x_m > 0.0).astype(np.uint16))
        painted = painted.set_column(painted.schema.get_field_index("views"), "views", views)
        footer = {FOOTER_KEY: pq.read_metadata(path).metadata[FOOTER_KEY]}
        pq.write_table(painted.replace_schema_metadata(footer), path, write_page_checksum=True)


def _loops() -> Loops:
    """Two candidates, one accepted."""
    columns = {
        name: np.zeros((2, *spec.shape), object if spec.dtype == "str" else spec.dtype)
        for name, spec in columns_of(Loops).items()
    }
    sessions = np.array(["drive", "drive"], object)
    columns |= {
        "session_i": sessions, "session_j": sessions, "scan_i": np.array([2, 3]), "scan_j": np.array([30, 31]),
        "source": np.array(["position", "position"], object), "reason": np.array(["fits", "does not"], object),
        "accepted": np.array([True, False]),
    }  # fmt: skip
    return Loops(**columns)


def _car() -> ObjectTracks:
    """A car that drives ten metres ahead for ten scans; in the last it stands."""
    n = 10
    ahead = np.tile(pose(np.eye(3), np.array([10.0, 0.0, -1.7])), (n, 1, 1))
    return ObjectTracks(
        scan_index=np.arange(5, 5 + n), stamp_ns=np.arange(n), track=np.zeros(n, np.int32), T_odom_object=ahead,
        T_lidar_object=ahead, length_m=np.full(n, 4.2), width_m=np.full(n, 1.8), height_m=np.full(n, 1.5),
        speed_m_s=np.full(n, 8.0), class_=np.full(n, ObjectClass.VEHICLE, np.uint8), dynamic=np.arange(n) < n - 1,
        score=np.ones(n),
    )  # fmt: skip


class Running:
    """A server in a thread of its own, with a small root so that there are nodes of all kinds."""

    def __init__(self, folder: Path, root_points: int = 2_000) -> None:
        self.server = Server(0, Answers(folder, root_points=root_points))

    def __enter__(self) -> Server:
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05})
        self.thread.start()
        return self.server

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


def points_of(glb: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and places in the map (n, 3) of a content, the turn to y up taken back."""
    length = int.from_bytes(glb[12:16], "little")
    body = json.loads(glb[20 : 20 + length])
    count, first = body["accessors"][0]["count"], 28 + length
    vertices = np.zeros(count, VERTEX)
    for field in VERTEX.names or ():
        kind = VERTEX[field]
        column = np.frombuffer(glb, kind.base, count * int(np.prod(kind.shape, dtype=int)), first)
        vertices[field] = column.reshape(count, *kind.shape)
        first += column.nbytes
    matrix = np.array(body["nodes"][0]["matrix"], float).reshape(4, 4).T
    turned = vertices["position"].astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
    return vertices, np.column_stack((turned[:, 0], -turned[:, 2], turned[:, 1]))
