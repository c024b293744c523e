"""Folders of PCD, PLY and .bin scans: every encoding, odd fields, broken files among good ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.pcd import _lzf
from scanloom.stages.logs.pointfiles import TOPIC, natural, open_point_files, read_points, stamp_from_name
from scanloom.stages.logs.records import Cloud, CloudFile
from tests.stages.logs.kitti_folder import log_of, stored_scan

STAMP_NS = 1_700_000_000_000_000_000
FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("t", "u4"), ("ring", "u2")]
PCD_TYPE = {"f": "F", "u": "U", "i": "I"}
PLY_TYPE = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}


def points(count: int = 64, fields: list[tuple[str, str]] = FIELDS) -> np.ndarray:
    rng = np.random.default_rng(0)
    table = np.zeros(count, [(name, "<" + kind) for name, kind in fields])
    for name, kind in fields:
        if name == "t":
            table[name] = np.linspace(0, 99_000_000, count)
        elif kind.startswith("f"):
            table[name] = rng.normal(0, 20, count).astype(np.float32)
        else:
            table[name] = rng.integers(0, 60, count)
    return table


def rows(table: np.ndarray) -> bytes:
    return "".join(" ".join(repr(v) for v in row) + "\n" for row in table.tolist()).encode()


def literals(data: bytes) -> bytes:
    """LZF of the plainest kind: runs of at most 32 literal bytes."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def pcd(table: np.ndarray, kind: str, *, height: int = 1) -> bytes:
    names = table.dtype.names or ()
    types = [table.dtype[name] for name in names]
    head = (
        "# .PCD v0.7\nVERSION 0.7\n"
        f"FIELDS {' '.join(names)}\nSIZE {' '.join(str(t.itemsize) for t in types)}\n"
        f"TYPE {' '.join(PCD_TYPE[t.kind] for t in types)}\nCOUNT {' '.join('1' for _ in names)}\n"
        f"WIDTH {len(table) // height}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA {kind}\n"
    ).encode()
    if kind == "ascii":
        return head + rows(table)
    if kind == "binary":
        return head + table.tobytes()
    columns = b"".join(table[name].tobytes() for name in names)
    packed = literals(columns)
    return head + np.array([len(packed), len(columns)], "<u4").tobytes() + packed


def ply(table: np.ndarray, kind: str) -> bytes:
    names = table.dtype.names or ()
    properties = "".join(f"property {PLY_TYPE[table.dtype[n].str[1:]]} {n}\n" for n in names)
    head = f"ply\nformat {kind} 1.0\ncomment made here\nelement vertex {len(table)}\n{properties}"
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if kind == "ascii":
        return head.encode() + rows(table)
    return head.encode() + table.astype(table.dtype.newbyteorder(">" if "big" in kind else "<")).tobytes()


ENCODED = [("pcd", "ascii"), ("pcd", "binary"), ("pcd", "binary_compressed"),
           ("ply", "ascii"), ("ply", "binary_little_endian"), ("ply", "binary_big_endian")]  # fmt: skip


def encoded(suffix: str, kind: str, table: np.ndarray) -> bytes:
    return pcd(table, kind) if suffix == "pcd" else ply(table, kind)


def check(cloud: Cloud, table: np.ndarray) -> None:
    for axis, column in zip("xyz", (cloud.x_m, cloud.y_m, cloud.z_m)):
        np.testing.assert_array_equal(column, table[axis].astype(np.float32))


@pytest.mark.parametrize("suffix, kind", ENCODED)
@pytest.mark.parametrize("coordinate", ["f4", "f8"])
def test_every_encoding_keeps_ring_and_time(tmp_path: Path, suffix: str, kind: str, coordinate: str) -> None:
    table = points(fields=[(n, coordinate if n in "xyz" else k) for n, k in FIELDS])
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(encoded(suffix, kind, table))
    cloud = read_points(path, STAMP_NS)
    check(cloud, table)
    np.testing.assert_array_equal(cloud.ring, table["ring"])
    np.testing.assert_allclose(cloud.intensity, table["intensity"])
    assert cloud.time_ns is not None
    np.testing.assert_array_equal(cloud.time_ns - STAMP_NS, table["t"].astype(np.int64))


def test_files_written_by_open3d(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    # Repeated values make its LZF emit back references.
    xyz = np.repeat(np.random.default_rng(0).normal(0, 10, (100, 3)).astype(np.float32), 4, axis=0)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
    cloud.point["intensity"] = o3d.core.Tensor(np.arange(400, dtype=np.float32)[:, None])
    for suffix in ("pcd", "ply"):
        for text, packed in ((True, False), (False, False), (False, True)):
            path = tmp_path / f"{text}{packed}.{suffix}"
            o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=text, compressed=packed)
            read = read_points(path, 0)
            np.testing.assert_allclose(np.column_stack((read.x_m, read.y_m, read.z_m)), xyz, atol=1e-4)
            np.testing.assert_array_equal(read.intensity, np.arange(400))


def test_organised_pcd_rows_are_beams(tmp_path: Path) -> None:
    azimuth, elevation = np.meshgrid(np.linspace(-3, 3, 100), np.radians(np.linspace(10, -20, 16)))
    table = np.zeros(1600, [(a, "<f4") for a in "xyz"])
    table["x"], table["y"] = (20 * np.cos(azimuth)).ravel(), (20 * np.sin(azimuth)).ravel()
    table["z"] = (20 * np.tan(elevation)).ravel()
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(table, "binary", height=16))
    np.testing.assert_array_equal(read_points(path, 0).ring, np.repeat(np.arange(16)[::-1], 100))


def test_pcd_columns_of_several_numbers_and_padding(tmp_path: Path) -> None:
    head = b"VERSION .7\nFIELDS x y z _ normal _\nSIZE 4 4 4 1 4 1\nTYPE F F F U F U\nCOUNT 1 1 1 4 3 2\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary\n"
    dtype = np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("p", "u1", 4), ("n", "<f4", 3), ("q", "u1", 2)]
    )
    table = np.zeros(2, dtype)
    table["x"], table["z"] = [1, 2], [5, 6]
    path = tmp_path / "a.pcd"
    path.write_bytes(head + table.tobytes())
    check(read_points(path, 0), table)


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 400))
def test_lzf_never_writes_outside_whatever_it_is_fed(packed: bytes, size: int) -> None:
    out = np.full(size + 16, 77, np.uint8)
    written = _lzf(np.frombuffer(packed, np.uint8), out[:size])
    assert -1 <= written <= size
    assert (out[size:] == 77).all()


def test_lzf_back_references() -> None:
    out = np.zeros(14, np.uint8)
    # "abc", then 4 and 7 more bytes from three back: the copy overlaps what it writes.
    packed = bytes([2, *b"abc", (2 << 5) | 0, 2, (5 << 5) | 0, 2])
    assert _lzf(np.frombuffer(packed, np.uint8), out) == 14
    assert out.tobytes() == b"abcabcabcabcab"


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(ENCODED), st.data())
def test_damage_gives_points_or_a_refusal_that_names_the_file(
    tmp_path: Path, form: tuple[str, str], data: st.DataObject
) -> None:
    whole = bytearray(encoded(*form, points(12)))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"a.{form[0]}"
    path.write_bytes(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
    try:
        read_points(path, STAMP_NS)
    except InvalidInput as refusal:
        where = refusal.where
    else:
        return
    assert where == str(path)


@pytest.mark.parametrize("suffix, kind", ENCODED)
def test_files_cut_short_are_refused(tmp_path: Path, suffix: str, kind: str) -> None:
    whole = encoded(suffix, kind, points())
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises(InvalidInput, match=r"cut short|no point"):
        read_points(path, 0)


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.pcd", "hello", "is not a PCD"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4\nTYPE F F F\nWIDTH 1\nDATA ascii\n1 2 3\n", "differ in length"),
        ("a.pcd", "FIELDS x y z\nSIZE 4 4 4\nTYPE F F Q\nWIDTH 1\nDATA ascii\n1 2 3\n", "unknown type Q4"),
        ("a.pcd", "FIELDS x y z\nWIDTH many\nDATA ascii\n1 2 3\n", "number for WIDTH"),
        ("a.pcd", "FIELDS x y z\nWIDTH 1\nDATA zipped\n1 2 3\n", "unknown DATA"),
        ("a.pcd", "FIELDS x y z\nWIDTH 999999999999\nDATA binary\n", "more than can be true"),
        ("a.pcd", "FIELDS a b c\nWIDTH 1\nDATA ascii\n1 2 3\n", "x is missing"),
        ("a.ply", "solid", "is not a PLY"),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement face 3\nproperty int a\nend_header\n",
            "before its vertices",
        ),
        (
            "a.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "not read",
        ),
        (
            "a.ply",
            "ply\nformat odd 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "without format",
        ),
        ("a.bin", "short", "holds no point"),
    ],
)
def test_files_that_are_no_scans_are_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidInput, match=words):
        read_points(tmp_path / name, 0)


# --- folders ---------------------------------------------------------------------------------------------------------


def stamps_of(source: object) -> list[int]:
    return [message.body.stamp_ns for message in source.messages({TOPIC})]  # type: ignore[attr-defined]


def test_scans_follow_in_natural_order_at_the_given_rate(tmp_path: Path) -> None:
    for i in (10, 9, 1):
        (tmp_path / f"scan_{i}.pcd").write_bytes(pcd(points(10 + i), "binary"))
    source = open_point_files(log_of(tmp_path), 20.0)
    assert source.format == "point files"
    assert stamps_of(source) == [0, 50_000_000, 100_000_000]
    loaded = [m.body.load() for m in source.messages({TOPIC}) if isinstance(m.body, CloudFile)]
    assert [len(cloud.x_m) for cloud in loaded] == [11, 19, 20]
    assert [p.code for p in source.problems] == ["points.rate_assumed"]


def test_names_that_are_times_give_the_stamps(tmp_path: Path) -> None:
    for name in ("1317042164.200000000", "1317042164.1", "1317042164.15"):
        (tmp_path / f"{name}.ply").write_bytes(ply(points(), "binary_little_endian"))
    source = open_point_files(log_of(tmp_path))
    assert stamps_of(source) == [1317042164_100_000_000, 1317042164_150_000_000, 1317042164_200_000_000]
    assert not source.problems


@pytest.mark.parametrize(
    "name, stamp_ns",
    [
        ("a/1317042164.103500.pcd", 1317042164_103_500_000),
        ("1317042164_000000123.pcd", 1317042164_000_000_123),
        ("1317042164103500000.bin", 1317042164_103_500_000),
        ("1317042164103500.bin", 1317042164_103_500_000),
        ("lidar_1317042164103500000.ply", 1317042164_103_500_000),
        ("000123.bin", None),
        ("0000000000000000123.bin", None),
        ("scan.bin", None),
        ("9999999999.5.pcd", None),
    ],
)
def test_stamps_in_names(name: str, stamp_ns: int | None) -> None:
    assert stamp_from_name(name) == stamp_ns


def test_natural_order() -> None:
    names = ["b2", "a10", "a9", "a", "10", "9", "a9b"]
    assert sorted(names, key=natural) == ["9", "10", "a", "a9", "a9b", "a10", "b2"]


def test_bin_scans_of_kitti_turn_clockwise_and_say_so(tmp_path: Path) -> None:
    table, ring = stored_scan(columns=100)
    table.tofile(tmp_path / "000000.bin")
    source = open_point_files(log_of(tmp_path))
    (message,) = source.messages({TOPIC})
    assert isinstance(message.body, CloudFile)
    cloud = message.body.load()
    np.testing.assert_array_equal(cloud.ring, ring)
    assert cloud.sweep is not None
    assert "points.no_times" in [p.code for p in source.problems]


def test_broken_files_are_named_and_the_others_go_on(tmp_path: Path) -> None:
    for i in range(5):
        (tmp_path / f"{i}.pcd").write_bytes(pcd(points(), "binary"))
    (tmp_path / "1.pcd").write_text("")
    (tmp_path / "2.pcd").write_text("not a cloud")
    (tmp_path / "3.pcd").write_bytes(pcd(points(), "binary")[:-100])
    source = open_point_files(log_of(tmp_path))
    broken = [p.text for p in source.problems if p.code == "points.broken"]
    assert [text.split()[0] for text in broken] == ["1.pcd", "2.pcd", "3.pcd"]
    # The scans that are left keep their own times.
    assert stamps_of(source) == [0, 400_000_000]


def test_a_folder_of_broken_files_is_refused(tmp_path: Path) -> None:
    for i in range(3):
        (tmp_path / f"{i}.ply").write_text("nothing")
    with pytest.raises(InvalidInput, match="none of 3 scan files"):
        open_point_files(log_of(tmp_path))
    with pytest.raises(InvalidInput, match="holds no scans"):
        open_point_files(log_of(tmp_path / "0.ply"))
