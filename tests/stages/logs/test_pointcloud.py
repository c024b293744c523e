"""Clouds as the drivers of the usual sensors write them, and times of points from their azimuth."""

from __future__ import annotations

import time

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.scans import Scan
from scanloom.stages.geometry.sweep import CLOCKWISE, COUNTER_CLOCKWISE, Sweep, detect_sweep, sweep_times
from scanloom.stages.logs.pointcloud import (
    azimuth_times,
    correct_vertical_angle,
    decode_livox,
    decode_pointcloud2,
)
from scanloom.stages.logs.records import LIVOX_POINT, Cloud, LivoxCloud, PointCloud2, PointField
from tests.worlds import street, sweep

STAMP_NS = 1_700_000_000_250_000_000
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
BEAMS, COLUMNS = 16, 256


def spin(beams: int = BEAMS, columns: int = COLUMNS) -> dict[str, np.ndarray]:
    """A clockwise sweep in firing order from the rear: coordinates, ring (0 lowest), seconds since its start."""
    azimuth = np.repeat(np.pi - np.linspace(0, 2 * np.pi, columns, endpoint=False), beams)
    elevation = np.tile(np.radians(np.linspace(-20, 10, beams)), columns)
    rng = np.random.default_rng(0)
    r = rng.uniform(3, 60, beams * columns)
    return {
        "x": r * np.cos(elevation) * np.cos(azimuth),
        "y": r * np.cos(elevation) * np.sin(azimuth),
        "z": r * np.sin(elevation),
        "ring": np.tile(np.arange(beams), columns),
        "seconds": np.repeat(np.linspace(0, 0.1, columns, endpoint=False), beams),
        "intensity": rng.integers(0, 255, beams * columns),
    }


def message(
    columns: dict[str, tuple[str, np.ndarray]], *, step: int | None = None, height: int = 1
) -> PointCloud2:
    """A cloud with these columns one after the other, padded to `step` bytes a point."""
    dtype = np.dtype([(name, "<" + kind) for name, (kind, _) in columns.items()])
    packed = np.dtype(
        {
            "names": list(columns),
            "formats": [dtype[n] for n in columns],
            "offsets": [dtype.fields[n][1] for n in columns],  # type: ignore[index]
            "itemsize": step or dtype.itemsize,
        }
    )
    count = len(next(iter(columns.values()))[1])
    table = np.zeros(count, packed)
    for name, (_, values) in columns.items():
        table[name] = values
    fields = tuple(PointField(n, packed.fields[n][1], CODES[k], 1) for n, (k, _) in columns.items())  # type: ignore[index]
    width = count // height
    return PointCloud2(
        stamp_ns=STAMP_NS, receive_ns=STAMP_NS + 5, frame_id="lidar", height=height, width=width, fields=fields,
        is_bigendian=False, point_step=packed.itemsize, row_step=packed.itemsize * width,
        data=np.frombuffer(table.tobytes(), np.uint8), is_dense=True,
    )  # fmt: skip


def xyz(points: dict[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
    return {axis: ("f4", points[axis]) for axis in "xyz"}


def offsets_s(cloud: Cloud) -> np.ndarray:
    assert cloud.time_ns is not None
    return (cloud.time_ns - STAMP_NS) * 1e-9


def test_velodyne() -> None:
    p = spin()
    cloud = decode_pointcloud2(
        message(
            {
                **xyz(p),
                "intensity": ("f4", p["intensity"]),
                "ring": ("u2", p["ring"]),
                "time": ("f4", p["seconds"] - 0.1),
            }
        )
    )
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"] - 0.1, atol=1e-8)
    np.testing.assert_array_equal(cloud.ring, p["ring"])
    np.testing.assert_array_equal(cloud.intensity, p["intensity"])
    assert cloud.remark == ""
    assert (cloud.stamp_ns, cloud.receive_ns) == (STAMP_NS, STAMP_NS + 5)


def test_ouster_organised_with_blank_points_and_beams_from_above() -> None:
    """128 x 1024 in rows, the top beam first, zeros where nothing came back; within a few ms."""
    beams, columns = 128, 1024
    p = {
        name: v.reshape(columns, beams)[:, ::-1].T.ravel().copy() for name, v in spin(beams, columns).items()
    }
    blank = np.random.default_rng(1).random(len(p["x"])) < 0.2
    for axis in "xyz":
        p[axis][blank] = 0
    # Ouster counts beams from the top.
    layout = {
        **xyz(p), "intensity": ("f4", p["intensity"]), "t": ("u4", np.where(blank, 0, p["seconds"] * 1e9)),
        "reflectivity": ("u2", p["intensity"]), "ring": ("u1", beams - 1 - p["ring"]), "ambient": ("u2", p["ring"]),
        "range": ("u4", p["ring"]),
    }  # fmt: skip
    made = message(layout, step=48, height=beams)
    cloud = decode_pointcloud2(made)
    np.testing.assert_allclose(offsets_s(cloud)[~blank], p["seconds"][~blank], atol=1e-8)
    np.testing.assert_array_equal(cloud.ring, p["ring"])
    assert "from above" in cloud.remark
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        decode_pointcloud2(made)
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.03


def test_hesai_and_robosense_absolute_seconds() -> None:
    p = spin()
    cloud = decode_pointcloud2(
        message(
            {
                **xyz(p),
                "intensity": ("u1", p["intensity"]),
                "timestamp": ("f8", STAMP_NS * 1e-9 + p["seconds"]),
                "ring": ("u2", p["ring"]),
            }
        )
    )
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=3e-7)
    assert cloud.remark == ""


def test_absolute_times_on_another_clock_start_at_the_header() -> None:
    """A sensor without GPS counts from its power-up; the first point is set to the header, and it is said."""
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "timestamp": ("f8", 1234.5 + p["seconds"])}))
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=3e-7)
    assert "another clock" in cloud.remark


def test_relative_timestamp_in_doubles() -> None:
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "timestamp": ("f8", p["seconds"])}))
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=1e-8)


def test_livox_pointcloud2_in_nanoseconds() -> None:
    p = spin()
    cloud = decode_pointcloud2(
        message({**xyz(p), "intensity": ("f4", p["intensity"]), "tag": ("u1", p["ring"]), "line": ("u1", p["ring"] % 4),
                 "timestamp": ("f8", STAMP_NS + p["seconds"] * 1e9)})
    )  # fmt: skip
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=5e-7)
    np.testing.assert_array_equal(cloud.ring, p["ring"] % 4)
    assert cloud.remark == ""


@pytest.mark.parametrize("timebase_ns, remarked", [(STAMP_NS, False), (77_000_000_000, True)])
@pytest.mark.parametrize("stride", [19, 20])
def test_livox_custom_message(timebase_ns: int, remarked: bool, stride: int) -> None:
    p = spin()
    dtype = np.dtype(
        {
            "names": list(LIVOX_POINT.names or ()),
            "formats": [LIVOX_POINT[n] for n in LIVOX_POINT.names or ()],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": stride,
        }
    )
    points = np.zeros(len(p["x"]), dtype)
    for axis in "xyz":
        points[axis] = p[axis]
    points["offset_time"] = p["seconds"] * 1e9
    points["reflectivity"], points["line"], points["tag"] = p["intensity"], p["ring"] % 6, 0x10
    points.flags.writeable = False
    cloud = decode_livox(LivoxCloud(STAMP_NS, STAMP_NS, "livox", timebase_ns, points))
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=1e-8)
    np.testing.assert_array_equal(cloud.return_no, 1)
    np.testing.assert_array_equal(cloud.intensity, p["intensity"])
    assert bool(cloud.remark) == remarked


@pytest.mark.parametrize(
    "kind, per_second, unit",
    [("u4", 1e6, "microseconds"), ("f4", 1e6, "microseconds"), ("f8", 1e3, "milliseconds")],
)
def test_unusual_units_are_found_and_said(kind: str, per_second: float, unit: str) -> None:
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "time": (kind, p["seconds"] * per_second)}))
    np.testing.assert_allclose(offsets_s(cloud), p["seconds"], atol=1.1e-6)
    assert unit in cloud.remark


@pytest.mark.parametrize("values", [0.0, 5.0, np.nan])
def test_a_time_field_that_tells_nothing_is_not_used(values: float) -> None:
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "time": ("f4", np.full(len(p["x"]), values))}))
    assert cloud.time_ns is None
    assert "azimuth" in cloud.remark


def test_a_time_field_whose_span_fits_no_unit_is_not_used() -> None:
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "time": ("f4", p["seconds"] * 30)}))
    assert cloud.time_ns is None
    assert "no duration of a sweep" in cloud.remark


def test_returns_counted_from_one_start_at_zero() -> None:
    p = spin()
    cloud = decode_pointcloud2(message({**xyz(p), "return_number": ("u1", 1 + p["ring"] % 2)}))
    np.testing.assert_array_equal(cloud.return_no, p["ring"] % 2)


def test_rows_of_an_organised_cloud_are_beams() -> None:
    p = {name: v.reshape(COLUMNS, BEAMS).T.ravel() for name, v in spin().items()}
    cloud = decode_pointcloud2(message(xyz(p), height=BEAMS))
    np.testing.assert_array_equal(cloud.ring, p["ring"])


def test_an_image_of_a_depth_camera_has_no_beams_but_stays_a_cloud() -> None:
    rng = np.random.default_rng(0)
    p = {axis: rng.normal(0, 1, 64 * 20) for axis in "xyz"}
    assert not decode_pointcloud2(message(xyz(p), height=64)).ring.any()


def test_an_empty_cloud() -> None:
    cloud = decode_pointcloud2(message({axis: ("f4", np.empty(0)) for axis in "xyz"}))
    assert len(cloud.x_m) == 0
    assert len(azimuth_times(cloud, 100_000_000)) == 0


@pytest.mark.parametrize(
    "change, words",
    [
        ({"row_step": 10, "height": 2, "width": 8}, "row_step is 10"),
        ({"height": 100}, "data has"),
        ({"fields": (PointField("x", 0, 7, 1), PointField("y", 4, 7, 1))}, "field z is missing"),
        ({"fields": (PointField("x", 0, 17, 1),)}, "unknown datatype 17"),
        ({"fields": (PointField("x", 10, 7, 1),)}, "past point_step"),
        ({"fields": ()}, "no fields"),
        ({"height": 0, "point_step": 2**31}, "point_step is 2147483648"),
    ],
)
def test_impossible_layouts_are_refused_by_name(change: dict[str, object], words: str) -> None:
    good = message(xyz(spin()))
    with pytest.raises(InvalidInput, match=words):
        decode_pointcloud2(PointCloud2(**{**vars(good), **change}))  # type: ignore[arg-type]


def test_the_longest_point_there_can_be_is_no_error_of_its_own() -> None:
    good = message(xyz(spin()))
    cloud = decode_pointcloud2(PointCloud2(**{**vars(good), "height": 0, "point_step": 2**31 - 1}))
    assert len(cloud.x_m) == 0


def test_one_row_with_a_careless_row_step_is_read_and_said() -> None:
    p = spin()
    good = message(xyz(p))
    cloud = decode_pointcloud2(PointCloud2(**{**vars(good), "row_step": 0}))
    np.testing.assert_array_equal(cloud.x_m, p["x"].astype(np.float32))
    assert "row_step is 0" in cloud.remark


# --- times from azimuth ----------------------------------------------------------------------------------------------

PERIOD_NS = 100_000_000


def bare(scan: Scan, order: np.ndarray | slice = slice(None)) -> Cloud:
    """A scan as a log without time fields would give it."""
    n = len(scan.x_m[order])
    return Cloud(
        stamp_ns=0, receive_ns=0, x_m=scan.x_m[order], y_m=scan.y_m[order], z_m=scan.z_m[order],
        intensity=np.zeros(n, np.float32), ring=np.zeros(n, np.uint16), return_no=np.zeros(n, np.uint8), time_ns=None,
    )  # fmt: skip


def still_sweep() -> tuple[Scan, np.ndarray]:
    """A sweep at standstill with its true times since the start of the sweep, ns."""
    scan = sweep(street(), np.eye(4), np.zeros(6), rng=np.random.default_rng(3))
    return scan, scan.stamp_ns - scan.reference_ns + PERIOD_NS // 2


def test_firing_order_gives_direction_seam_and_times() -> None:
    scan, truth = still_sweep()
    found = detect_sweep(scan.x_m, scan.y_m)
    assert (found.direction, found.in_firing_order, found.detected) == (CLOCKWISE, True, True)
    error = azimuth_times(bare(scan), PERIOD_NS) - truth
    # One column of 512 lasts 195 us; the first return, which marks the seam, may come a column late.
    assert np.abs(error).max() < 400_000


def test_a_counter_clockwise_sensor_is_noticed() -> None:
    scan, truth = still_sweep()
    mirrored = bare(scan)
    mirrored = Cloud(**{**vars(mirrored), "y_m": -scan.y_m})
    assert detect_sweep(mirrored.x_m, mirrored.y_m).direction == COUNTER_CLOCKWISE
    assert np.abs(azimuth_times(mirrored, PERIOD_NS) - truth).max() < 400_000


def test_beam_by_beam_order_gives_the_same_times() -> None:
    scan, truth = still_sweep()
    order = np.argsort(scan.ring, kind="stable")
    found = detect_sweep(scan.x_m[order], scan.y_m[order])
    assert (found.direction, found.in_firing_order, found.detected) == (CLOCKWISE, False, True)
    error = azimuth_times(bare(scan, order), PERIOD_NS) - truth[order]
    wrapped = (error + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2
    # The lowest beam's first return gives the seam; points before it fall to the other end of the sweep.
    assert np.abs(wrapped).max() < 3_000_000
    assert np.mean(np.abs(error) > 3_000_000) < 0.02


def test_a_shuffled_cloud_tells_nothing_and_is_cut_at_the_rear() -> None:
    scan, truth = still_sweep()
    order = np.random.default_rng(0).permutation(len(truth))
    assert not detect_sweep(scan.x_m[order], scan.y_m[order]).detected
    # The small world's sensor does start at the rear, so even then the times are right.
    error = azimuth_times(bare(scan, order), PERIOD_NS) - truth[order]
    assert np.quantile(np.abs(error), 0.99) < 400_000


def test_a_sensor_that_does_not_spin_gets_one_time() -> None:
    scan, _ = still_sweep()
    ahead = np.flatnonzero((scan.x_m > 0) & (np.abs(scan.y_m) < scan.x_m))
    order = np.random.default_rng(0).permutation(ahead)
    np.testing.assert_array_equal(azimuth_times(bare(scan, order), PERIOD_NS), PERIOD_NS // 2)


def test_times_stay_within_the_sweep_whatever_the_points() -> None:
    x = np.array([0, np.nan, 1, -1, -1, 1, np.inf, 0], np.float32)
    y = np.array([0, 1, 0, 1e-9, -1e-9, np.nan, 1, -1], np.float32)
    for direction in (CLOCKWISE, COUNTER_CLOCKWISE):
        for seam in (-np.pi, 0.0, 3.0, np.pi):
            for firing in (True, False):
                times = sweep_times(x, y, PERIOD_NS, Sweep(direction, seam, firing, True))
                assert times.min() >= 0
                assert times.max() < PERIOD_NS


def test_vertical_correction_turns_beams_and_keeps_ranges() -> None:
    scan, _ = still_sweep()
    before = bare(scan)
    after = correct_vertical_angle(before, np.radians(0.205))
    np.testing.assert_allclose(
        np.hypot(np.hypot(after.x_m, after.y_m), after.z_m), np.linalg.norm(scan.points(), axis=1), rtol=1e-5
    )
    rise = np.arctan2(after.z_m, np.hypot(after.x_m, after.y_m)) - np.arctan2(
        before.z_m, np.hypot(before.x_m, before.y_m)
    )
    np.testing.assert_allclose(np.degrees(rise), 0.205, atol=1e-3)
    np.testing.assert_allclose(
        np.arctan2(after.y_m, after.x_m), np.arctan2(before.y_m, before.x_m), atol=1e-5
    )
