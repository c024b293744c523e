"""GPX read by gpxpy, GeoJSON by shapely; both against PROJ's own transformation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import Georeference
from scanloom.schemas.trajectory import Poses
from scanloom.stages.exports.antimeridian import cut_line, unrolled, wrapped
from scanloom.stages.exports.geojson import write_geojson
from scanloom.stages.exports.gpx import write_gpx
from scanloom.stages.exports.options import Options
from scanloom.stages.geometry.geodesy import world_to_geodetic
from tests.stages.exports.tracks import CAPE_TOWN, FIJI, MUNICH, START_NS, delivered, poses_along, way

OPTIONS = Options()


def expected(origin: Georeference, poses: Poses) -> np.ndarray:
    """Latitude, longitude, height."""
    return world_to_geodetic(origin, poses.T_world_lidar[:, :3, 3])


@pytest.mark.parametrize("origin", [MUNICH, CAPE_TOWN, FIJI], ids=["north", "south", "date line"])
def test_gpxpy_reads_gpx(tmp_path: Path, origin: Georeference) -> None:
    gpxpy = pytest.importorskip("gpxpy")
    sessions = {
        "a & <b>": poses_along(way(20), origin),
        "c": poses_along(way(1), origin, start_ns=START_NS + 10**12),
    }
    (path,) = write_gpx(delivered(tmp_path / "m", origin, sessions), tmp_path, OPTIONS)
    gpx = gpxpy.parse(path.read_text())
    assert gpx.version == "1.1"
    assert "ellipsoid" in gpx.description
    assert [track.name for track in gpx.tracks] == list(sessions)
    for track, poses in zip(gpx.tracks, sessions.values(), strict=True):
        (segment,) = track.segments
        read = np.array([(p.latitude, p.longitude, p.elevation) for p in segment.points])
        want = expected(origin, poses)
        np.testing.assert_allclose(read[:, 0], want[:, 0], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose((read[:, 1] - want[:, 1] + 180.0) % 360.0, 180.0, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(read[:, 2], want[:, 2], rtol=0.0, atol=1e-4)
        assert (read[:, 1] >= -180.0).all() and (read[:, 1] < 180.0).all()
        stamps = [p.time.timestamp() for p in segment.points]
        np.testing.assert_allclose(stamps, poses.stamp_ns * 1e-9, rtol=0.0, atol=2e-6)


def features(tmp_path: Path, origin: Georeference, sessions: dict[str, Poses]) -> dict:
    (path,) = write_geojson(delivered(tmp_path / "m", origin, sessions), tmp_path, OPTIONS)
    return json.loads(path.read_text())


@pytest.mark.parametrize("origin", [MUNICH, CAPE_TOWN], ids=["north", "south"])
def test_shapely_reads_geojson(tmp_path: Path, origin: Georeference) -> None:
    shapely = pytest.importorskip("shapely")
    sessions = {
        "a": poses_along(way(20), origin),
        "b": poses_along(way(9), origin, start_ns=START_NS + 10**12),
    }
    collection = features(tmp_path, origin, sessions)
    assert collection["type"] == "FeatureCollection"
    for feature, (name, poses) in zip(collection["features"], sessions.items(), strict=True):
        line = shapely.from_geojson(json.dumps(feature["geometry"]))
        assert line.geom_type == "LineString"
        want = expected(origin, poses)[:, [1, 0, 2]]
        got = shapely.get_coordinates(line, include_z=True)
        np.testing.assert_allclose(got[:, :2], want[:, :2], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(got[:, 2], want[:, 2], rtol=0.0, atol=1e-4)
        about = feature["properties"]
        steps = np.linalg.norm(np.diff(poses.T_world_lidar[:, :3, 3], axis=0), axis=1)
        assert about["session"] == name and about["scans"] == len(poses)
        assert about["length_m"] == pytest.approx(steps.sum(), abs=1e-3)
        assert about["duration_s"] == pytest.approx(0.1 * (len(poses) - 1))
    assert collection["features"][0]["properties"]["start"] == "2025-10-09T08:53:20.049951Z"
    both = np.vstack([expected(origin, poses)[:, [1, 0, 2]] for poses in sessions.values()])
    bounds = np.concatenate((both.min(axis=0), both.max(axis=0)))
    np.testing.assert_allclose(collection["bbox"], bounds, rtol=0.0, atol=1e-4)


def test_a_line_over_the_date_line_is_cut(tmp_path: Path) -> None:
    poses = poses_along(way(20), FIJI)
    assert expected(FIJI, poses)[0, 1] > 0.0 > expected(FIJI, poses)[-1, 1]
    collection = features(tmp_path, FIJI, {"a": poses})
    geometry = collection["features"][0]["geometry"]
    assert geometry["type"] == "MultiLineString"
    west_of, east_of = (np.array(part) for part in geometry["coordinates"])
    assert len(west_of) + len(east_of) == 20 + 2
    assert (west_of[:, 0] > 179.0).all() and (east_of[:, 0] < -179.0).all()
    assert west_of[-1, 0] == 180.0 and east_of[0, 0] == -180.0
    np.testing.assert_array_equal(west_of[-1, 1:], east_of[0, 1:])
    west, _, _, east, _, _ = collection["bbox"]
    assert west > 179.0 and east < -179.0


def test_short_sessions(tmp_path: Path) -> None:
    sessions = {"a": poses_along(way(0), MUNICH), "b": poses_along(way(1), MUNICH)}
    collection = features(tmp_path, MUNICH, sessions)
    nothing, point = (feature["geometry"] for feature in collection["features"])
    assert nothing is None
    assert point["type"] == "Point" and len(point["coordinates"]) == 3


@pytest.mark.parametrize("write", [write_gpx, write_geojson])
def test_a_map_without_georeference_is_refused(tmp_path: Path, write) -> None:
    source = delivered(tmp_path / "m", None, {"a": poses_along(way(3), None)})
    with pytest.raises(InvalidInput, match="has no georeference"):
        write(source, tmp_path, OPTIONS)


def test_longitudes_within_range_keep_their_bits() -> None:
    longitudes = np.random.default_rng(4).uniform(11.0, 12.0, 1000)
    np.testing.assert_array_equal(wrapped(longitudes), longitudes)
    np.testing.assert_array_equal(unrolled(longitudes), longitudes)
    np.testing.assert_allclose(
        wrapped([180.0, -180.0, 540.0, 179.5, -181.0]), [-180, -180, -180, 179.5, 179.0]
    )
    np.testing.assert_allclose(unrolled([179.0, -179.0, 178.0]), [179.0, 181.0, 178.0])
    np.testing.assert_allclose(unrolled([-179.0, 179.0]), [-179.0, -181.0])
    assert len(unrolled([])) == 0


def test_a_line_that_comes_back_is_cut_twice() -> None:
    pieces = cut_line([[179.0, 0.0], [-179.0, 2.0], [179.0, 4.0]])
    assert [piece[:, 0].tolist() for piece in pieces] == [
        [179.0, 180.0],
        [-180.0, -179.0, -180.0],
        [180.0, 179.0],
    ]
    assert [piece[:, 1].tolist() for piece in pieces] == [[0.0, 1.0], [1.0, 2.0, 3.0], [3.0, 4.0]]
    westwards = cut_line([[-179.0, 0.0], [179.0, 2.0]])
    assert [piece[:, 0].tolist() for piece in westwards] == [[-179.0, -180.0], [180.0, 179.0]]
