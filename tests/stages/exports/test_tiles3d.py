"""3D Tiles: read with another library, all points stand where the map has them, on the Earth or in the map's own frame."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports import node_points
from scanloom.stages.exports.formats import FORMATS
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from scanloom.stages.exports.tiles3d import MARGIN_M
from scanloom.stages.geometry.geodesy import ecef_pose, georeference, projected_to_world, world_to_geodetic
from tests.delivered import cut, write_map

trimesh = pytest.importorskip("trimesh")
ORIGIN = georeference(-33.9, 18.4, 120.0)
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""What readers of 3D Tiles do with contents, which have y up."""


def scene(count: int = 70_000) -> np.ndarray:
    points = np.random.default_rng(2).uniform((-70, -40, -1), (30, 60, 12), (count, 3))
    return points.astype(np.float32).astype(float)


@pytest.fixture(scope="module", params=[True, False], ids=["on the Earth", "local"])
def exported(request, tmp_path_factory) -> tuple[Path, bool]:
    folder = tmp_path_factory.mktemp("tiles3d")
    points = scene()
    columns = {
        "intensity": np.arange(len(points), dtype=np.float32),
        "class_": np.where(points[:, 2] < 0, PointClass.GROUND, PointClass.STATIC).astype(np.uint8),
    }
    earth = ORIGIN.model_dump() if request.param else None
    write_map(folder / "map", cut(points, columns=columns, georeference=earth))
    (folder / "out").mkdir()
    written = FORMATS["3dtiles"].write(MapSource.open(folder / "map"), folder / "out", Options())
    assert {p for p in (folder / "out").rglob("*") if p.is_file()} == set(written)
    return folder / "out", request.param


def tiles(path: Path, T: np.ndarray | None = None) -> Iterator[tuple[dict[str, Any], np.ndarray, Path]]:
    """All tiles of a tileset and of those within, with their transform and the folder of their contents."""
    body = json.loads(path.read_text())
    assert body["asset"]["version"] == "1.1"
    waiting = [(body["root"], np.eye(4) if T is None else T, body["geometricError"])]
    while waiting:
        tile, above, error = waiting.pop()
        here = above @ np.reshape(tile["transform"], (4, 4)).T if "transform" in tile else above
        assert tile["refine"] == "ADD" and 0 <= tile["geometricError"] <= error
        uri = tile.get("content", {}).get("uri", "")
        if uri.endswith(".json"):
            yield from tiles(path.parent / uri, here)
        else:
            yield tile, here, path.parent
        waiting += [(child, here, tile["geometricError"]) for child in tile.get("children", [])]


def read(path: Path) -> np.ndarray:
    """Points (n, 3) of a content as the tile has them, by trimesh, which puts the nodes' transforms on."""
    (cloud,) = trimesh.load_scene(path).dump()
    return np.asarray(cloud.vertices) @ Z_UP[:3, :3].T


def test_all_points_stand_where_the_map_has_them(exported: tuple[Path, bool]) -> None:
    folder, on_earth = exported
    got, files = [], set()
    for tile, T, base in tiles(folder / "tileset.json"):
        if "content" in tile:
            path = base / tile["content"]["uri"]
            files.add(path)
            local = read(path)
            box = np.array(tile["boundingVolume"]["box"])
            off = np.abs(local - box[:3])
            assert (off <= box[[3, 7, 11]] + 1e-4).all()
            got.append(local @ T[:3, :3].T + T[:3, 3])
    places = np.concatenate(got)
    assert files == set(folder.rglob("*.glb")) and len(files) > 20
    assert (folder / "tiles" / "0_0.json").exists()
    truth = scene()
    if on_earth:
        lon, lat, h = Transformer.from_crs(4978, 4979, always_xy=True).transform(*places.T)
        geodetic = world_to_geodetic(ORIGIN, truth)
        assert np.allclose(
            [lat.min(), lon.min(), h.min()], geodetic.min(axis=0), rtol=0, atol=[1e-8, 1e-8, 1e-3]
        )
        east, north = Transformer.from_crs(4326, ORIGIN.epsg, always_xy=True).transform(lon, lat)
        places = projected_to_world(ORIGIN, np.column_stack((east, north, h)))
    off, row = cKDTree(truth).query(places)
    assert np.array_equal(np.sort(row), np.arange(len(truth)))
    assert off.max() < 2e-4


def test_boxes_hold_what_is_below(exported: tuple[Path, bool]) -> None:
    folder, _ = exported
    truth = scene()
    root = json.loads((folder / "tileset.json").read_text())["root"]
    box = np.array(root["boundingVolume"]["box"])
    half = box[[3, 7, 11]]
    assert np.allclose(box[:3] - half, truth.min(axis=0) - MARGIN_M, atol=1e-5)
    assert np.allclose(box[:3] + half, truth.max(axis=0) + MARGIN_M, atol=1e-5)
    assert ("transform" in root) == exported[1]


def test_contents_say_what_their_attributes_mean(exported: tuple[Path, bool]) -> None:
    data = (exported[0] / "root.glb").read_bytes()
    assert data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") == len(data)
    body = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    attributes = body["meshes"][0]["primitives"][0]["attributes"]
    meaning = body["extensions"]["EXT_structural_metadata"]
    known = meaning["schema"]["classes"]["point"]["properties"]
    for name, place in meaning["propertyAttributes"][0]["properties"].items():
        assert name in known and place["attribute"] in attributes
    for view, accessor in zip(body["bufferViews"], body["accessors"], strict=True):
        assert view["byteOffset"] % 4 == 0 and view["byteStride"] % 4 == 0
        assert view["byteLength"] == view["byteStride"] * accessor["count"]


def test_the_frame_stands_on_the_earth_as_proj_says() -> None:
    for origin in (ORIGIN, georeference(48.1, 11.5, 560.0), georeference(0.0, -179.9, -30.0)):
        T = ecef_pose(origin)
        assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
        points = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 2000, 0], [0, 0, 300], [-5000, 4000, -20]])
        lat, lon, h = world_to_geodetic(origin, points).T
        wanted = np.column_stack(Transformer.from_crs(4979, 4978, always_xy=True).transform(lon, lat, h))
        assert np.abs(points @ T[:3, :3].T + T[:3, 3] - wanted).max() < 1e-6


def test_colours_are_bright_on_both_scales_of_intensity() -> None:
    classes = np.array([1, 1, 2, 2], np.uint8)
    for top in (1.0, 255.0):
        colours = node_points._colours(np.array([0.0, top, 0.0, top]), classes)
        assert (colours[1, :3] > colours[0, :3] + 100).all() and (colours[3, :3] > colours[2, :3] + 100).all()
        assert colours[1, 0] > colours[1, 2] and colours[3, 0] < colours[3, 2]
        assert (colours[:, 3] == 255).all()
