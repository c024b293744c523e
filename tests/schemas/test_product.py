"""Products on disk: damage is found and named, foreign files are refused, parts come in order."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from scanloom.schemas.errors import InvalidInput, ProductError
from scanloom.schemas.product import (
    Document,
    Files,
    Part,
    Parts,
    Stream,
    Table,
    attribute,
    column,
    columns_of,
)


@dataclass(frozen=True)
class Rows(Table):
    """A table with one column of each kind."""

    NAME: ClassVar[str] = "rows"

    stamp_ns: NDArray[np.int64] = column("i8", "when", unit="ns")
    T: NDArray[np.float64] = column("f8", "a pose", unit="m", shape=(4, 4), frame="map")
    word: NDArray[np.object_] = column("str", "a word")
    origin: str = attribute("where it comes from")


@dataclass(frozen=True)
class OtherRows(Rows):
    """The same columns under another name."""

    NAME: ClassVar[str] = "other_rows"


@dataclass(frozen=True)
class NewerRows(Rows):
    """The same table after its layout changed."""

    SCHEMA_VERSION: ClassVar[int] = 2


class Flow(Stream[Rows]):
    """A stream of them."""

    NAME = "flow"
    ITEM = Rows


@dataclass(frozen=True)
class Papers(Files):
    """Some files."""

    NAME: ClassVar[str] = "papers"


class Note(Document):
    """A small document."""

    NAME: ClassVar[str] = "note"

    text: str
    number: float = 0.0


def rows(count: int = 50, seed: int = 0) -> Rows:
    rng = np.random.default_rng(seed)
    return Rows(
        stamp_ns=np.arange(count, dtype=np.int64) * 100,
        T=rng.normal(size=(count, 4, 4)),
        word=np.array([f"w{i % 3}" for i in range(count)], dtype=object),
        origin="here",
    )


def opened(path: Path) -> Rows | None:
    """The table, or None where its damage was found; any other error than ProductError fails the test."""
    try:
        return Rows.open(path)
    except ProductError:
        return None


def test_any_flipped_byte_is_found_or_harmless(tmp_path: Path) -> None:
    """Page checksums cover the data; a flip in the footer either fails to parse or leaves the same table."""
    path = tmp_path / "rows.parquet"
    made = rows()
    made.write(path)
    whole = path.read_bytes()
    found = 0
    for position in range(0, len(whole), 17):
        damaged = bytearray(whole)
        damaged[position] ^= 0x40
        path.write_bytes(bytes(damaged))
        again = opened(path)
        if again is None:
            found += 1
        else:
            assert again.T.tobytes() == made.T.tobytes()
            assert again.stamp_ns.tobytes() == made.stamp_ns.tobytes()
    assert found > 0.8 * len(range(0, len(whole), 17))


def test_a_flipped_byte_in_a_stream_hits_its_item_only(tmp_path: Path) -> None:
    path = tmp_path / "flow.parquet"
    Flow([rows(200, 1), rows(200, 2)]).write(path)
    end = pq.ParquetFile(path).metadata.row_group(0).column(1)
    whole = bytearray(path.read_bytes())
    whole[end.data_page_offset + end.total_compressed_size // 2] ^= 1
    path.write_bytes(bytes(whole))
    flow = Flow.open(path)
    with pytest.raises(ProductError, match="cannot be read"):
        flow[0]
    assert flow[1].T.tobytes() == rows(200, 2).T.tobytes()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_named(tmp_path: Path, share: float) -> None:
    path = tmp_path / "rows.parquet"
    rows().write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ProductError, match=r"rows\.parquet"):
        Rows.open(path)


@pytest.mark.parametrize("kind", [OtherRows, NewerRows])
def test_another_name_or_version_is_refused(tmp_path: Path, kind: type[Rows]) -> None:
    path = tmp_path / "rows.parquet"
    rows().write(path)
    with pytest.raises(ProductError, match="holds rows version 1"):
        kind.open(path)


def test_a_parquet_file_of_others_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.parquet"
    pq.write_table(pa.table({"stamp_ns": [1, 2]}), path)
    with pytest.raises(ProductError, match="not a rows file"):
        Rows.open(path)


def test_a_missing_file_is_a_product_error(tmp_path: Path) -> None:
    for kind in (Rows, Flow, Note, Papers):
        with pytest.raises(ProductError):
            kind.open(tmp_path / "nowhere")


def test_footer_describes_the_columns(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    rows().write(path)
    file = pq.ParquetFile(path)
    footer = json.loads(file.metadata.metadata[b"scanloom"])
    assert footer["columns"]["T"]["frame"] == "map"
    assert footer["attributes"] == {"origin": "here"}
    assert file.schema_arrow.field("stamp_ns").metadata[b"unit"] == b"ns"
    encodings = {
        file.metadata.row_group(0).column(i).path_in_schema: file.metadata.row_group(0).column(i).encodings
        for i in range(3)
    }
    assert "BYTE_STREAM_SPLIT" in encodings["T.list.element"]
    assert "DELTA_BINARY_PACKED" in encodings["stamp_ns"]


def test_take_concatenate_and_empty() -> None:
    a, b = rows(5, 1), rows(3, 2)
    both = Rows.concatenate([a, b])
    assert len(both) == 8
    np.testing.assert_array_equal(both.take(slice(5, 8)).T, b.T)
    np.testing.assert_array_equal(both.take(both.stamp_ns == 0).stamp_ns, [0, 0])
    assert len(Rows.empty(origin="none")) == 0


def test_a_stream_from_a_generator_has_no_index_until_written(tmp_path: Path) -> None:
    flow = Flow(item for item in [rows(2)])
    with pytest.raises(TypeError, match="no length"):
        len(flow)
    flow.write(tmp_path / "flow.parquet")
    assert len(Flow.open(tmp_path / "flow.parquet")) == 1


def test_a_document_round_trip_and_its_refusals(tmp_path: Path) -> None:
    path = tmp_path / "note.json"
    note = Note(text="grüße", number=float("inf"))
    note.write(path)
    assert Note.open(path) == note
    first = path.read_bytes()
    note.write(path)
    assert path.read_bytes() == first
    for text in ("", "{", "[]", '{"schema": "note", "version": 1}', '{"schema": "note", "version": 2, "text": "a"}',
                 '{"schema": "other", "version": 1, "text": "a"}', '{"schema": "note", "version": 1, "text": "a", "x": 1}'):  # fmt: skip
        path.write_text(text)
        with pytest.raises(ProductError, match=r"note\.json"):
            Note.open(path)


def test_files_from_bytes_and_writers(tmp_path: Path) -> None:
    def write(stream: Any) -> None:
        stream.write(b"written")

    made = Papers(contents={"a/b.bin": b"bytes", "c.txt": write})
    assert made.read("c.txt") == b"written"
    assert made.write(tmp_path / "out") == 2
    again = Papers.open(tmp_path / "out")
    assert again.names == ("a/b.bin", "c.txt")
    assert again.read("a/b.bin") == b"bytes"
    with pytest.raises(ProductError, match="no file"):
        again.path("../secret")


@dataclass(frozen=True)
class Kinds(Table):
    """Numbers of several widths, alone and several to a cell."""

    NAME: ClassVar[str] = "kinds"

    stamp_ns: NDArray[np.int64] = column("i8", "when", unit="ns")
    x_m: NDArray[np.float32] = column("f4", "where", unit="m")
    kind: NDArray[np.uint8] = column("u1", "what")
    sure: NDArray[np.bool_] = column("?", "whether")
    T: NDArray[np.float64] = column("f8", "a pose", unit="m", shape=(4, 4))
    flags: NDArray[np.bool_] = column("?", "more of that", shape=(3,))


class ManyKinds(Stream[Kinds]):
    """A stream of them."""

    NAME = "many_kinds"
    ITEM = Kinds


def kinds(count: int) -> Kinds:
    rng = np.random.default_rng(count)
    return Kinds(
        stamp_ns=np.arange(count, dtype=np.int64), x_m=rng.normal(size=count).astype(np.float32),
        kind=rng.integers(0, 9, count, dtype=np.uint8), sure=rng.random(count) < 0.5,
        T=rng.normal(size=(count, 4, 4)), flags=rng.random((count, 3)) < 0.5,
    )  # fmt: skip


@pytest.mark.parametrize("count", [1, 3, 200_000])
def test_arrays_of_a_file_cannot_be_written_whatever_its_size(tmp_path: Path, count: int) -> None:
    """Else a stage that writes into its input would work on small files only."""
    made = kinds(count)
    made.write(tmp_path / "kinds.parquet")
    ManyKinds([made, made]).write(tmp_path / "many.parquet")
    many = ManyKinds.open(tmp_path / "many.parquet")
    for read in (Kinds.open(tmp_path / "kinds.parquet"), many[1], *many):
        for name in columns_of(Kinds):
            array = getattr(read, name)
            np.testing.assert_array_equal(array, getattr(made, name))
            with pytest.raises(ValueError, match="read-only"):
                array[-1] = array[0]


def test_parts_are_ordered_and_grouped() -> None:
    coordinates = [("b", "0001"), ("a", "0001"), ("a", "0000")]
    parts = Parts(((("session", s), ("chunk", c)), Note(text=s + c)) for s, c in coordinates)
    assert [note.text for note in parts] == ["a0000", "a0001", "b0001"]
    assert list(parts.by("session")) == ["a", "b"]
    assert len(parts.by("session")["a"]) == 2
    assert next(iter(parts.items()))[0] == {"session": "a", "chunk": "0000"}
    assert Part(Note(text="x"), "0000").key == "0000"


def test_errors_survive_pickling() -> None:
    import pickle

    error = InvalidInput("what", where="where", next_step="next")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (InvalidInput, str(error))
    assert io.StringIO(str(error)).getvalue() == "where: what Next: next"
