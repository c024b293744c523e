"""ROS 1 bags and sqlite bags: whole, without index, cut, damaged."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from scanloom.schemas.errors import InvalidInput, ScanloomError
from scanloom.stages.logs.database import DatabaseFile
from scanloom.stages.logs.rosbag import Rosbag1File
from tests.stages.logs.writing import ROS1, ROS2, drive, write_rosbag1, write_rosbag2
from tests.stages.test_ingest import run

Messages = list[tuple[int, str, bytes]]


def messages(path: Path) -> Messages:
    file = DatabaseFile(path) if path.suffix == ".db3" else Rosbag1File(path)
    found = file.read(set(file.channels))
    return [(m.receive_ns, file.channels[m.channel].topic, bytes(m.data)) for m in found]


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_reads_what_another_library_reads(tmp_path: Path, compression: str) -> None:
    from rosbags.rosbag1 import Reader

    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1), compression)
    with Reader(path) as reader:
        expected = [(stamp, connection.topic, bytes(raw)) for connection, stamp, raw in reader.messages()]
    assert sorted(messages(path)) == sorted(expected)
    assert [m[0] for m in messages(path)] == sorted(m[0] for m in expected)


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_cut_anywhere_gives_the_beginning(tmp_path: Path, compression: str) -> None:
    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1), compression)
    whole, data = messages(path), path.read_bytes()
    counts = []
    for share in range(1, 50):
        path.write_bytes(data[: len(data) * share // 50])
        found = messages(path)
        assert found == whole[: len(found)]
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[25] > len(whole) * 0.2


def test_a_cut_bag_knows_how_much_is_missing(tmp_path: Path) -> None:
    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1, scans=10))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    result = run(path)
    [problem] = [p for p in result.session.problems if p.code == "log.incomplete"]
    assert "% of the log is missing" in problem.text
    share = int(problem.text.split(" % of the log")[0].split()[-1])
    assert 40 <= share <= 55
    assert 3 <= len(result.scans) <= 7


def test_a_recording_that_was_not_closed_is_complete_but_says_so(tmp_path: Path) -> None:
    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1))
    whole, data = messages(path), path.read_bytes()
    at = data.find(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", data, at)
    unclosed = bytearray(data[:index])
    unclosed[at : at + 8] = bytes(8)
    active = tmp_path / "b.bag.active"
    active.write_bytes(unclosed)
    assert messages(active) == whole
    assert "not closed" in run(active).session.problems[0].text


def test_reading_goes_on_after_destroyed_records(tmp_path: Path) -> None:
    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1))
    whole, data = messages(path), bytearray(path.read_bytes())
    at = data.find(b"op=\x05", len(data) // 2)
    data[at - 40 : at + 30] = b"\xff" * 70
    path.write_bytes(data)
    found = messages(path)
    assert set(found) <= set(whole)
    assert len(whole) * 0.7 < len(found) < len(whole)


def test_a_chunk_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    path = write_rosbag1(tmp_path / "a.bag", drive(ROS1), "bz2")
    data = path.read_bytes()
    at = data.find(b"size=")
    path.write_bytes(data[: at + 5] + struct.pack("<I", 0xFFFFFFFF) + data[at + 9 :])
    result = run(path)
    assert "GiB" in result.session.problems[0].text
    assert len(result.scans) >= 3


def test_old_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    with pytest.raises(InvalidInput, match="format 1"):
        run(path)


def test_a_cut_database_gives_its_first_rows(tmp_path: Path) -> None:
    [path] = write_rosbag2(tmp_path / "bag", drive(ROS2, scans=12), "sqlite").glob("*.db3")
    whole, data = messages(path), path.read_bytes()
    counts = []
    for share in range(1, 12):
        path.write_bytes(data[: len(data) * share // 12])
        try:
            found = messages(path)
        except ScanloomError:
            continue
        assert set(found) <= set(whole)
        counts.append(len(found))
    assert counts[-1] > len(whole) * 0.7
    assert counts[len(counts) // 2] > len(whole) * 0.2


def test_rows_still_in_the_write_ahead_log_are_read(tmp_path: Path) -> None:
    import shutil
    import sqlite3

    [path] = write_rosbag2(tmp_path / "bag", drive(ROS2), "sqlite").glob("*.db3")
    whole = messages(path)
    base = sqlite3.connect(path)
    base.execute("PRAGMA journal_mode=WAL")
    base.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, 1800000000000000000, x'00010000')"
    )
    base.commit()
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    for file in path.parent.glob("*.db3*"):
        shutil.copy(file, crashed / file.name)
    base.close()
    assert len(messages(crashed / path.name)) == len(whole) + 1


@pytest.mark.parametrize("storage", ["sqlite", "mcap"])
def test_missing_parts_are_named(tmp_path: Path, storage: str) -> None:
    folder = write_rosbag2(tmp_path / "bag", drive(ROS2), storage)
    about = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(about.replace("message_count: ", "message_count: 1"))
    result = run(folder)
    assert not result.session.complete
    assert "messages are missing" in result.session.problems[0].text
    assert len(result.scans) == 5


def test_split_bags_are_one_log(tmp_path: Path) -> None:
    items = list(drive(ROS1, scans=8))
    for part in range(3):
        share = items[len(items) * part // 3 : len(items) * (part + 1) // 3]
        write_rosbag1(tmp_path / f"drive_{2 - part}.bag", iter(share))
    result = run(tmp_path)
    assert len(result.scans) == 8
    assert len(result.imu) == 80
    assert result.session.complete


def test_a_packed_bomb_is_refused(tmp_path: Path) -> None:
    import zstandard

    path = tmp_path / "a.mcap.zstd"
    path.write_bytes(zstandard.compress(bytes(64 << 20)))
    with pytest.raises(InvalidInput, match="unpacks to more than"):
        run(path)
