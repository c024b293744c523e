"""MCAP: whole, cut anywhere, damaged, hostile."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import pytest

from scanloom.schemas.errors import InvalidInput, ScanloomError
from scanloom.stages.logs.containers import DamageError, decompress
from scanloom.stages.logs.mcap import McapFile
from tests.stages.logs.writing import ROS1, ROS2, drive, write_mcap
from tests.stages.test_ingest import run


def messages(path: Path) -> list[tuple[int, str, bytes]]:
    file = McapFile(path)
    found = file.read(set(file.channels))
    return [(m.receive_ns, file.channels[m.channel].topic, bytes(m.data)) for m in found]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("profile", ["ros1", "ros2"])
def test_reads_what_the_library_of_the_format_reads(tmp_path: Path, compression: str, profile: str) -> None:
    from mcap.reader import make_reader

    store = ROS1 if profile == "ros1" else ROS2
    path = write_mcap(tmp_path / "a.mcap", drive(store), profile=profile, compression=compression)
    with path.open("rb") as stream:
        expected = [(m.log_time, c.topic, m.data) for _, c, m in make_reader(stream).iter_messages()]
    assert sorted(messages(path)) == sorted(expected)
    assert [m[0] for m in messages(path)] == sorted(m[0] for m in expected)


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_cut_anywhere_gives_the_beginning_or_a_clear_error(tmp_path: Path, compression: str) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2), compression=compression)
    whole, data = messages(path), path.read_bytes()
    counts = []
    for share in range(1, 60):
        path.write_bytes(data[: len(data) * share // 60])
        found = messages(path)
        assert found == whole[: len(found)]
        counts.append(len(found))
        assert McapFile(path).damage or len(found) == len(whole)
    assert counts == sorted(counts)
    assert counts[30] > len(whole) * 0.2


def test_first_half_is_mapped_and_says_what_was_lost(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2, scans=10), compression="zstd")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    result = run(path)
    assert 3 <= len(result.scans) <= 6
    assert not result.session.complete
    [problem] = [p for p in result.session.problems if p.code == "log.incomplete"]
    assert "cut" in problem.text
    assert f"{len(result.scans)} scans" in problem.text


def test_cut_before_the_second_scan_is_no_log(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])
    with pytest.raises(InvalidInput, match=r"1 readable scan; a map needs at least two.*damaged"):
        run(path)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_flipped_byte_costs_one_chunk(tmp_path: Path, compression: str) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2), compression=compression)
    whole, data = messages(path), bytearray(path.read_bytes())
    for share in (0.2, 0.35, 0.5, 0.65):
        broken = bytearray(data)
        broken[int(len(data) * share)] ^= 0x10
        path.write_bytes(broken)
        file = McapFile(path)
        found = messages(path)
        assert set(found) <= set(whole)
        assert len(whole) * 0.6 < len(found) < len(whole)
        list(file.read(set(file.channels)))
        assert file.damage
        assert 0 < file.damage.lost_bytes < len(data) / 2


def test_reading_goes_on_after_a_destroyed_record(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(ROS2), compression="zstd")
    whole, data = messages(path), bytearray(path.read_bytes())
    start = data.find(b"\x04\0\0\0zstd", len(data) // 3) - 37
    data[start : start + 9] = b"\xff" * 9
    path.write_bytes(data)
    found = messages(path)
    assert len(whole) * 0.6 < len(found) < len(whole)
    # the same without the summary that lists the chunks
    path.write_bytes(data[: int(len(data) * 0.8)])
    assert found[: len(messages(path))] == messages(path)
    assert len(messages(path)) > len(whole) * 0.4


def chunk_record(declared: int, compression: bytes, data: bytes) -> bytes:
    body = struct.pack("<QQQI", 1, 2, declared, 0) + struct.pack("<I", len(compression)) + compression
    body += struct.pack("<Q", len(data)) + data
    return (
        b"\x89MCAP0\r\n\x01" + struct.pack("<Q", 8) + bytes(8) + b"\x06" + struct.pack("<Q", len(body)) + body
    )


def test_bombs_do_not_go_off(tmp_path: Path) -> None:
    import lz4.frame
    import zstandard

    zeros = bytes(64 << 20)
    bombs = {b"zstd": zstandard.compress(zeros), b"lz4": lz4.frame.compress(zeros)}
    for name, packed in bombs.items():
        path = tmp_path / f"{name.decode()}.mcap"
        # a small declared size is believed, and no more than that is unpacked
        with pytest.raises(DamageError):
            decompress(name.decode(), memoryview(b"\xff" + packed), 1000)
        assert len(decompress(name.decode(), memoryview(packed), 1000)) == 1000
        # a large one is refused before anything is unpacked
        path.write_bytes(chunk_record(1 << 40, name, packed))
        with pytest.raises(InvalidInput, match=r"1024\.0 GiB"):
            run(path)


@pytest.mark.parametrize(
    "content", [b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(500), b"\x89MCAP0\r\n" + b"\xff" * 500]
)
def test_a_file_of_the_right_beginning_and_nothing_else(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(ScanloomError):
        run(path)


def test_messages_of_overlapping_chunks_come_in_order(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "a.mcap"
    buffer = io.BytesIO()
    writer = Writer(buffer, chunk_size=200)
    writer.start()
    channel = writer.register_channel(
        "/a", "cdr", writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
    )
    for stamp in (5, 1, 9, 3, 12, 10, 4, 15, 14):
        writer.add_message(channel, stamp, bytes(100), stamp)
    writer.finish()
    path.write_bytes(buffer.getvalue())
    assert [m[0] for m in messages(path)] == [1, 3, 4, 5, 9, 10, 12, 14, 15]
