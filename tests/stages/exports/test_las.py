"""LAZ 1.4, read with laspy and copclib."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS

from scanloom.schemas.scans import PointClass
from scanloom.stages.exports.coordinates import Projector
from scanloom.stages.exports.las import write_laz
from scanloom.stages.exports.las_points import CLASSES, gps_time, intensity_scale
from scanloom.stages.exports.options import Options
from scanloom.stages.exports.source import MapSource
from tests.delivered import cut, write_map
from tests.stages.exports.clouds import MUNICH, PUNTA_ARENAS, add_removed, column, expected, scattered, write
from tests.tiles import tile_of

laspy = pytest.importorskip("laspy")


@pytest.mark.parametrize(
    ("origin", "far_m"),
    [(MUNICH, (0.0, 0.0)), (PUNTA_ARENAS, (0.0, 0.0)), (MUNICH, (-60_000.0, 41_000.0)), (None, (0.0, 0.0))],
)
def test_points_bounds_and_system(tmp_path: Path, origin, far_m: tuple[float, float]) -> None:
    source = write(tmp_path / "m", scattered(1, far_m=far_m), origin)
    projector = Projector.of(source, Options())
    found = laspy.read(write_laz(source, tmp_path, Options())[0])
    right = expected(source, projector)
    assert len(found.points) == source.points == len(right)
    assert np.abs(found.xyz - right).max() < 0.00052
    assert np.abs(found.header.mins - right.min(axis=0)).max() < 0.00052
    assert np.abs(found.header.maxs - right.max(axis=0)).max() < 0.00052
    assert found.header.parse_crs() == projector.crs
    assert found.header.number_of_points_by_return[0] == source.points
    assert str(found.header.version) == "1.4" and found.header.point_format.id == 6
    assert found.header.global_encoding.wkt


def test_attributes(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(2), origin=None)
    found = laspy.read(write_laz(source, tmp_path, Options())[0])
    assert np.array_equal(found.classification, np.where(column(source, "class_") == PointClass.GROUND, 2, 1))
    assert np.array_equal(found["count"], column(source, "count"))
    assert np.array_equal(found["level"], column(source, "level"))
    assert np.array_equal(found.point_source_id, 2 - column(source, "session"))
    assert np.abs(found.intensity - column(source, "intensity").astype(float) * 257.0).max() <= 0.5001
    normals = np.column_stack([found[f"normal_{axis}"] for axis in "xyz"])
    assert np.abs(normals - column(source, "normal") / 127.0).max() < 0.012
    assert not np.any(found.withheld)
    assert np.all(np.asarray(found.return_number) == 1) and np.all(np.asarray(found.number_of_returns) == 1)


def test_times_are_adjusted_gps(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(3, 50))
    found = laspy.read(write_laz(source, tmp_path, Options())[0])
    assert found.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    since_1980_ns = column(source, "first_ns") - 315_964_800 * 10**9 + 18 * 10**9
    assert np.abs(found.gps_time - (since_1980_ns - 10**18) / 1e9).max() < 1e-6
    assert (
        found.header.creation_date
        == datetime.fromtimestamp(column(source, "first_ns").max() / 1e9, UTC).date()
    )


@pytest.mark.parametrize(
    ("moment", "gps_less_utc"),
    [
        ("2011-09-26T13:02:25", 15),
        ("2016-12-31T23:59:59", 17),
        ("2017-01-01T00:00:00", 18),
        ("2024-05-01T00:00:00", 18),
    ],
)
def test_leap_seconds(moment: str, gps_less_utc: int) -> None:
    utc = datetime.fromisoformat(moment).replace(tzinfo=UTC)
    stamp_ns = np.array([int(utc.timestamp()) * 10**9])
    since_1980 = (utc - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds()
    assert gps_time(stamp_ns)[0] == since_1980 + gps_less_utc - 1e9


def test_a_clock_that_does_not_know_the_date_is_kept(tmp_path: Path) -> None:
    source = write(
        tmp_path / "m", scattered(3, 50), first_ns=np.arange(50) * 10**9, last_ns=np.arange(50) * 10**9
    )
    found = laspy.read(write_laz(source, tmp_path, Options())[0])
    assert found.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME
    assert sorted(found.gps_time) == list(range(50))


@pytest.mark.parametrize(
    ("strongest", "scale"),
    [(0.0, 65535.0), (1.0, 65535.0), (1.01, 257.0), (255.0, 257.0), (256.0, 1.0), (65535.0, 1.0)],
)
def test_intensities_fill_sixteen_bits(strongest: float, scale: float) -> None:
    assert intensity_scale(strongest) == scale
    assert intensity_scale(131_070.0) == 0.5


def test_every_class_has_its_own_code_but_noise() -> None:
    assert CLASSES[PointClass.UNLABELLED] == 0
    kept = [CLASSES[c] for c in PointClass if c not in (PointClass.OUTLIER, PointClass.OUT_OF_RANGE)]
    assert len(set(kept)) == len(kept)
    assert (
        CLASSES[PointClass.OUTLIER] == 7
        and CLASSES[PointClass.AIRBORNE] == 18
        and CLASSES[PointClass.DYNAMIC] == 64
    )


def test_removed_points_are_withheld(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(5, 100))
    add_removed(tmp_path / "m", scattered(6, 30) % 50.0)
    found = laspy.read(write_laz(source, tmp_path, Options(removed=True))[0])
    withheld = np.asarray(found.withheld, bool)
    assert len(found.points) == 130 and withheld.sum() == 30
    assert sorted(set(np.asarray(found.classification)[withheld])) == [7, 18, 64]


def test_one_file_per_tile(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(6, 500))
    whole, *single = write_laz(source, tmp_path, Options(per_tile=True))
    assert [path.stem for path in single] == source.tile_names
    assert any("-" in path.stem for path in single)
    together = np.concatenate([laspy.read(path).xyz for path in single])
    assert np.array_equal(together, laspy.read(whole).xyz)


def test_one_point_and_a_tile_without_any(tmp_path: Path) -> None:
    source = write(tmp_path / "m", np.array([[-0.5, -120.25, 3.0]]))
    tile_of(np.empty((0, 3)), georeference=MUNICH.model_dump()).write(tmp_path / "m/tiles/5_5.parquet")
    found = laspy.read(write_laz(source, tmp_path, Options())[0])
    assert np.abs(found.xyz - expected(source, Projector.of(source, Options()))).max() < 0.00052


def test_an_empty_tile_among_others(tmp_path: Path) -> None:
    origin = MUNICH.model_dump()
    tiles = cut(scattered(7, 60), georeference=origin)
    write_map(tmp_path / "m", tiles)
    first = next(iter(tiles))
    tiles[first].take(slice(0, 0)).write(tmp_path / f"m/tiles/{first}.parquet")
    left = 60 - len(tiles[first])
    paths = write_laz(MapSource.open(tmp_path / "m"), tmp_path, Options(per_tile=True))
    assert len(laspy.read(paths[0]).points) == left and len(paths) == len(tiles)


def test_the_same_bytes_twice(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(8, 300))
    bytes_of = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        bytes_of.append(write_laz(source, tmp_path / name, Options())[0].read_bytes())
    assert bytes_of[0] == bytes_of[1]


def test_another_reader(tmp_path: Path) -> None:
    copclib = pytest.importorskip("copclib")
    source = write(tmp_path / "m", scattered(9, 300))
    reader = copclib.LazReader(str(write_laz(source, tmp_path, Options())[0]))
    assert reader.laz_config.las_header.point_count == 300
    assert reader.laz_config.las_header.scale.x == 0.001


def test_the_system_stands_where_las_wants_it(tmp_path: Path) -> None:
    source = write(tmp_path / "m", scattered(9, 30))
    head = write_laz(source, tmp_path, Options())[0].read_bytes()
    at, texts = struct.unpack_from("<H", head, 94)[0], []
    for _ in range(struct.unpack_from("<I", head, 100)[0]):
        user, record, length = struct.unpack_from("<16sHH", head, at + 2)
        texts += (
            [head[at + 54 : at + 54 + length]]
            if (user.rstrip(b"\0"), record) == (b"LASF_Projection", 2112)
            else []
        )
        at += 54 + length
    assert len(texts) == 1
    assert CRS.from_wkt(texts[0].rstrip(b"\0").decode()) == Projector.of(source, Options()).crs
