"""Products: typed, self-describing, checked when they are made, written and read.

Four kinds cover everything that flows:

* `Table`    columns of equal length, in memory, one Parquet file;
* `Stream`   a sequence of tables (one row group each), read and written one at a time;
* `Document` a small JSON object;
* `Files`    opaque named files in formats of the outside world (MCAP, PLY, PNG, HTML).

A product may be *split* along one axis (`SPLIT_BY`): it is then stored in parts, one file each.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, ClassVar, Generic, Self, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, ValidationError

from scanloom.schemas.errors import ProductError

FOOTER_KEY = b"scanloom"
STRING = "str"

Coordinate = tuple[tuple[str, str], ...]
"""Where a part stands: pairs (axis, value), for instance (("session", "a"), ("chunk", "0003"))."""


@dataclass(frozen=True)
class Column:
    """Meaning of one column: numpy dtype (or `str`), shape of one cell, unit, frame, one sentence."""

    dtype: str
    doc: str
    unit: str = ""
    shape: tuple[int, ...] = ()
    frame: str = ""

    @property
    def width(self) -> int:
        return int(np.prod(self.shape, dtype=int))


def column(dtype: str, doc: str, *, unit: str = "", shape: tuple[int, ...] = (), frame: str = "") -> Any:
    """Declare a column of a `Table`."""
    return field(metadata={"column": Column(dtype, doc, unit, shape, frame)})


def attribute(doc: str, *, default: Any = dataclasses.MISSING) -> Any:
    """Declare a JSON value that holds for the whole table; it is kept in the footer."""
    return field(metadata={"attribute": doc}, default=default)


class Product:
    """Base of every product: a stable name, a version of its layout, the axis it is split along."""

    NAME: ClassVar[str]
    SCHEMA_VERSION: ClassVar[int] = 1
    SPLIT_BY: ClassVar[str | None] = None
    SUFFIX: ClassVar[str] = ""

    def write(self, path: Path) -> int:
        """Write to `path`; return the number of rows or items."""
        raise NotImplementedError

    @classmethod
    def open(cls, path: Path) -> Self:
        """Read from `path`, lazily where the product is big.

        Raises
        ------
        ProductError : the file is damaged or holds something else.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class Table(Product):
    """Columns of equal length. Subclasses are frozen dataclasses of `column`s and `attribute`s."""

    SUFFIX: ClassVar[str] = ".parquet"
    ON_THE_WAY: ClassVar[bool] = False
    """Whether only the next stage reads it: then it is written quickly rather than small."""
    PACKED: ClassVar[bool] = False
    """Whether its bytes are compressed already. Parquet makes four of each; split by place, three of them cost nothing."""

    def __post_init__(self) -> None:
        rows = None
        for name, spec in columns_of(type(self)).items():
            array = getattr(self, name)
            _check_column(type(self).__name__, name, spec, array)
            if rows is not None and len(array) != rows:
                raise ProductError(
                    f"{type(self).__name__}.{name} has {len(array)} rows where {rows} are expected"
                )
            rows = len(array)

    def __len__(self) -> int:
        first = next(iter(columns_of(type(self))))
        return len(getattr(self, first))

    @classmethod
    def empty(cls, **attributes: Any) -> Self:
        """A table without rows."""
        arrays = {name: _blank(spec) for name, spec in columns_of(cls).items()}
        return cls(**arrays, **attributes)

    def take(self, rows: Any) -> Self:
        """The given rows (mask, slice or indices), in that order."""
        picked = {name: getattr(self, name)[rows] for name in columns_of(type(self))}
        return dataclasses.replace(self, **picked)

    @classmethod
    def concatenate(cls, tables: Sequence[Self]) -> Self:
        """Rows of several tables in sequence; attributes are the first table's."""
        names = columns_of(cls)
        joined = {name: np.concatenate([getattr(t, name) for t in tables]) for name in names}
        return dataclasses.replace(tables[0], **joined)

    @property
    def attributes(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in attributes_of(type(self))}

    def to_arrow(self) -> pa.Table:
        names = columns_of(type(self))
        arrays = [_to_arrow(getattr(self, name), spec) for name, spec in names.items()]
        return pa.Table.from_arrays(arrays, schema=arrow_schema(type(self)))

    @classmethod
    def from_arrow(cls, table: pa.Table, attributes: Mapping[str, Any], where: str = "") -> Self:
        arrays = {}
        for name, spec in columns_of(cls).items():
            if name not in table.column_names:
                raise ProductError(f"column {name} of {cls.NAME} is missing", where=where)
            arrays[name] = _from_arrow(table.column(name), spec, name, where)
        if not _required_attributes(cls) <= set(attributes) <= set(attributes_of(cls)):
            raise ProductError(f"attributes {sorted(attributes)} are not those of {cls.NAME}", where=where)
        return cls(**arrays, **attributes)

    def write(self, path: Path) -> int:
        return self.write_to(path)

    def write_to(self, sink: Path | IO[bytes]) -> int:
        """As `write`, also into an open file."""
        options = (_quick_options if self.ON_THE_WAY else _writer_options)(type(self))
        with pq.ParquetWriter(sink, arrow_schema(type(self)), **options) as writer:
            table, first = self.to_arrow(), 0
            for rows in self.row_groups():
                writer.write_table(table.slice(first, rows), row_group_size=max(rows, 1))
                first += rows
            writer.add_key_value_metadata({FOOTER_KEY: _footer(type(self), self.attributes)})
        return len(self)

    def row_groups(self) -> tuple[int, ...]:
        """Rows of each row group of the file, in sequence; a reader may want some of them only."""
        return (len(self),)

    @classmethod
    def open(cls, path: Path, groups: int | None = None) -> Self:
        """`groups` reads only so many row groups, from the first."""
        with _NamingDamage(path):
            file = pq.ParquetFile(path, page_checksum_verification=True)
            footer = _read_footer(file, cls, path)
            if groups is None:
                rows = file.read(use_threads=False)
            else:
                wanted = range(min(groups, file.num_row_groups))
                rows = file.read_row_groups(wanted, use_threads=False)
            return cls.from_arrow(rows, footer["attributes"], str(path))


ItemT = TypeVar("ItemT", bound=Table)
Through = Callable[[Iterator[Any]], Iterator[Any]]


class Stream(Product, Generic[ItemT]):
    """A sequence of tables that is never wholly in memory; one row group per item.

    Items come from any iterable (each may be consumed once) or from a file (any number of times).
    Attributes of the items are kept in the footer, so `index` lists them without reading a row.
    """

    ITEM: ClassVar[type[Table]]
    SUFFIX: ClassVar[str] = ".parquet"

    def __init__(self, items: Iterable[ItemT]) -> None:
        self._items = items

    def __iter__(self) -> Iterator[ItemT]:
        return iter(self._items)

    def __len__(self) -> int:
        if not isinstance(self._items, _FileItems | Sequence):
            raise TypeError(f"{type(self).__name__} is still a generator and has no length")
        return len(self.index)

    @property
    def index(self) -> Sequence[Mapping[str, Any]]:
        """Attributes of every item (and `rows`), in order."""
        if isinstance(self._items, _FileItems):
            return self._items.index
        if isinstance(self._items, Sequence):
            return [{**item.attributes, "rows": len(item)} for item in self._items]
        raise ProductError(f"{type(self).__name__} is still a generator and has no index")

    def __getitem__(self, i: int) -> ItemT:
        if isinstance(self._items, (_FileItems, Sequence)):
            item: ItemT = self._items[i]
            return item
        raise ProductError(f"{type(self).__name__} is still a generator and cannot be indexed")

    def write(self, path: Path) -> int:
        return self.write_to(path)

    def write_to(self, sink: Path | IO[bytes]) -> int:
        """As `write`, also into an open file."""
        index: list[dict[str, Any]] = []
        options = _quick_options(self.ITEM)
        with pq.ParquetWriter(sink, arrow_schema(self.ITEM), **options) as writer:
            for item in self._items:
                writer.write_table(item.to_arrow(), row_group_size=max(len(item), 1))
                index.append({**item.attributes, "rows": len(item)})
            writer.add_key_value_metadata({FOOTER_KEY: _footer(type(self), {"items": index})})
        return len(index)

    @classmethod
    def open(cls, path: Path, through: Through = iter) -> Self:
        """`through` wraps each pass over the items of the file, for instance to read ahead."""
        with _NamingDamage(path):
            file = pq.ParquetFile(path, page_checksum_verification=True)
            footer = _read_footer(file, cls, path)
        return cls(_FileItems(path, cls.ITEM, footer["attributes"]["items"], through))


class _FileItems:
    """Items of a stream in a file: row group i is item i, also when it is empty."""

    def __init__(
        self, path: Path, item: type[Table], index: list[dict[str, Any]], through: Through = iter
    ) -> None:
        self.path = path
        self._through = through
        self.item = item
        self.index = index

    def __len__(self) -> int:
        return len(self.index)

    def __iter__(self) -> Iterator[Any]:
        return self._through(self._pass())

    def _pass(self) -> Iterator[Any]:
        with _NamingDamage(self.path):
            file = pq.ParquetFile(self.path, page_checksum_verification=True)
        for i in range(len(self.index)):
            yield self._read(file, i)

    def __getitem__(self, i: int) -> Any:
        with _NamingDamage(self.path):
            file = pq.ParquetFile(self.path, page_checksum_verification=True)
        return self._read(file, i)

    def _read(self, file: pq.ParquetFile, i: int) -> Table:
        attributes = {k: v for k, v in self.index[i].items() if k != "rows"}
        if not self.index[i]["rows"]:
            return self.item.empty(**attributes)
        with _NamingDamage(self.path):
            rows = file.read_row_group(i, use_threads=False)
            return self.item.from_arrow(rows, attributes, f"{self.path}, row group {i}")


class Document(BaseModel, Product):
    """A small JSON object, checked by pydantic."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="constants")

    SUFFIX: ClassVar[str] = ".json"

    def write(self, path: Path) -> int:
        body = {"schema": self.NAME, "version": self.SCHEMA_VERSION, **self.model_dump(mode="json")}
        path.write_text(json.dumps(body, indent=1, sort_keys=True) + "\n")
        return 1

    @classmethod
    def open(cls, path: Path) -> Self:
        try:
            body = json.loads(path.read_text())
            if not isinstance(body, dict):
                raise ValueError("not a JSON object")
            _check_identity(cls, body.pop("schema", ""), body.pop("version", 0), path)
            return cls.model_validate(body)
        except (OSError, ValueError, ValidationError) as error:
            raise _damaged(path, error) from error


FileWriter = Callable[[IO[bytes]], None]


@dataclass(frozen=True)
class Files(Product):
    """Named files in formats of the outside world.

    Either files that exist (`root` and `names`), or files still to be written (`contents`).
    """

    root: Path | None = None
    names: tuple[str, ...] = ()
    contents: Mapping[str, bytes | FileWriter] = field(default_factory=dict)

    def path(self, name: str) -> Path:
        if self.root is None or name not in self.names:
            raise ProductError(
                f"{self.NAME} holds no file {name}", next_step="run the stage that writes it again"
            )
        return self.root / name

    def read(self, name: str) -> bytes:
        if name in self.contents:
            content = self.contents[name]
            if isinstance(content, bytes):
                return content
            buffer = io.BytesIO()
            content(buffer)
            return buffer.getvalue()
        return self.path(name).read_bytes()

    def write(self, path: Path) -> int:
        path.mkdir(parents=True, exist_ok=True)
        for name in self.names:
            target = path / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(self.path(name).read_bytes())
        for name, content in self.contents.items():
            target = path / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as stream:
                if isinstance(content, bytes):
                    stream.write(content)
                else:
                    content(stream)
        return len(self.names) + len(self.contents)

    @classmethod
    def open(cls, path: Path) -> Self:
        if not path.is_dir():
            raise ProductError(f"folder of {cls.NAME} is missing", where=str(path))
        found = sorted(p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file())
        return cls(root=path, names=tuple(found))


ProductT = TypeVar("ProductT", bound=Product)


@dataclass(frozen=True)
class Part(Generic[ProductT]):
    """One part of a product that is split along `SPLIT_BY`, on its way out of a stage."""

    product: ProductT
    key: str


class Parts(Sequence[ProductT]):
    """Products of one type from several places, ordered by coordinate.

    With `load`, the entries are what `load` makes products of, each time one is asked for: a thousand tiles are then
    in memory one by one.
    """

    def __init__(
        self, parts: Iterable[tuple[Coordinate, Any]], *, load: Callable[[Any], ProductT] | None = None
    ) -> None:
        self._parts = sorted(parts, key=lambda pair: pair[0])
        self._load = load

    def _product(self, entry: Any) -> ProductT:
        product: ProductT = entry if self._load is None else self._load(entry)
        return product

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self._product(entry) for _, entry in self._parts[i]]
        return self._product(self._parts[i][1])

    def __iter__(self) -> Iterator[ProductT]:
        return (self._product(entry) for _, entry in self._parts)

    def items(self) -> Iterator[tuple[dict[str, str], ProductT]]:
        return ((dict(coordinate), self._product(entry)) for coordinate, entry in self._parts)

    def coordinates(self) -> list[dict[str, str]]:
        """Where the parts stand, without loading one."""
        return [dict(coordinate) for coordinate, _ in self._parts]

    def by(self, axis: str) -> dict[str, Parts[ProductT]]:
        """Group by one axis, for instance `by("session")`, in sorted order."""
        groups: dict[str, list[tuple[Coordinate, Any]]] = {}
        for coordinate, entry in self._parts:
            groups.setdefault(dict(coordinate)[axis], []).append((coordinate, entry))
        return {value: Parts(group, load=self._load) for value, group in sorted(groups.items())}


# ---------------------------------------------------------------------------------------------------------------------


ValueT = TypeVar("ValueT")


def _per_type(function: Callable[[type[Table]], ValueT]) -> Callable[[type[Table]], ValueT]:
    """Remember what a function says of each table; tables are declared once and never change."""
    known: dict[type[Table], ValueT] = {}

    def remembered(table: type[Table]) -> ValueT:
        if table not in known:
            known[table] = function(table)
        return known[table]

    return remembered


@_per_type
def columns_of(table: type[Table]) -> dict[str, Column]:
    return {f.name: f.metadata["column"] for f in dataclasses.fields(table) if "column" in f.metadata}


@_per_type
def attributes_of(table: type[Table]) -> dict[str, str]:
    return {f.name: f.metadata["attribute"] for f in dataclasses.fields(table) if "attribute" in f.metadata}


@_per_type
def _required_attributes(table: type[Table]) -> set[str]:
    """Those without a default: files of a time when the others did not exist can still be read."""
    defaults = {f.name: f.default for f in dataclasses.fields(table)}
    return {name for name in attributes_of(table) if defaults[name] is dataclasses.MISSING}


@_per_type
def arrow_schema(table: type[Table]) -> pa.Schema:
    fields = []
    for name, spec in columns_of(table).items():
        kind = _arrow_type(spec)
        about = {"unit": spec.unit, "frame": spec.frame, "doc": spec.doc}
        fields.append(pa.field(name, kind, nullable=False, metadata=about))
    return pa.schema(fields)


def describe(product: type[Product]) -> list[tuple[str, Column]]:
    """The data dictionary of a table or stream: (column name, meaning)."""
    table = product.ITEM if issubclass(product, Stream) else product
    return list(columns_of(table).items()) if issubclass(table, Table) else []


def _arrow_type(spec: Column) -> pa.DataType:
    if spec.dtype == STRING:
        return pa.string()
    if _is_bytes(spec):
        return pa.binary(spec.width)
    scalar = pa.from_numpy_dtype(np.dtype(spec.dtype))
    if not spec.shape:
        return scalar
    return pa.list_(pa.field("element", scalar, nullable=False), spec.width)


def _is_bytes(spec: Column) -> bool:
    """Rows of small numbers are kept as strings of bytes: as a list, Parquet would make four bytes of each."""
    return spec.dtype == "u1" and bool(spec.shape)


def _blank(spec: Column) -> np.ndarray:
    dtype = object if spec.dtype == STRING else np.dtype(spec.dtype)
    return np.empty((0, *spec.shape), dtype)


def _check_column(table: str, name: str, spec: Column, array: Any) -> None:
    wanted = np.dtype(object) if spec.dtype == STRING else np.dtype(spec.dtype)
    if not isinstance(array, np.ndarray):
        raise ProductError(f"{table}.{name} must be a numpy array, not {type(array).__name__}")
    if array.dtype != wanted or array.shape[1:] != spec.shape or array.ndim != 1 + len(spec.shape):
        raise ProductError(
            f"{table}.{name} must be {wanted}[n{''.join(f', {s}' for s in spec.shape)}], "
            f"not {array.dtype}{list(array.shape)}"
        )


def _to_arrow(array: np.ndarray, spec: Column) -> pa.Array:
    if spec.dtype == STRING:
        return pa.array(array.tolist(), pa.string())
    if _is_bytes(spec):
        data = pa.py_buffer(np.ascontiguousarray(array))
        return pa.FixedSizeBinaryArray.from_buffers(_arrow_type(spec), len(array), [None, data])
    flat = pa.array(np.ascontiguousarray(array).reshape(-1))
    if not spec.shape:
        return flat
    return pa.FixedSizeListArray.from_arrays(flat, type=_arrow_type(spec))


def _from_arrow(chunked: pa.ChunkedArray, spec: Column, name: str, where: str) -> np.ndarray:
    if chunked.type != _arrow_type(spec):
        raise ProductError(f"column {name} is {chunked.type}, expected {_arrow_type(spec)}", where=where)
    if chunked.null_count:
        raise ProductError(f"column {name} holds {chunked.null_count} nulls", where=where)
    array = chunked.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    if spec.dtype == STRING:
        return np.array(array.to_pylist(), dtype=object)
    if _is_bytes(spec):
        flat = _bytes_of(array, spec.width)
    else:
        flat = (array.flatten() if spec.shape else array).to_numpy(zero_copy_only=False)
    flat.setflags(write=False)  # else it would depend on the size of a file whether its arrays can be written
    return flat.reshape(-1, *spec.shape) if spec.shape else flat


def _bytes_of(array: pa.FixedSizeBinaryArray, width: int) -> np.ndarray:
    """The bytes of all rows, one after the other."""
    data = array.buffers()[1]
    if not len(array) or data is None:
        return np.empty(0, np.uint8)
    return np.frombuffer(data, np.uint8)[array.offset * width : (array.offset + len(array)) * width]


@_per_type
def _writer_options(table: type[Table]) -> dict[str, Any]:
    """Encodings per leaf: byte-stream split for floats, deltas for stamps, dictionaries for strings."""
    encodings: dict[str, str] = {}
    dictionaries: list[str] = []
    for name, spec in columns_of(table).items():
        leaf = f"{name}.list.element" if spec.shape and not _is_bytes(spec) else name
        if spec.dtype == STRING:
            dictionaries.append(leaf)
        elif np.dtype(spec.dtype).kind == "f":
            encodings[leaf] = "BYTE_STREAM_SPLIT"
        elif name.endswith("stamp_ns"):
            encodings[leaf] = "DELTA_BINARY_PACKED"
        else:
            encodings[leaf] = "PLAIN"
    return {
        "compression": "zstd",
        "compression_level": 1,
        "use_dictionary": dictionaries or False,
        "column_encoding": encodings,
        "write_page_checksum": True,
    }


@_per_type
def _quick_options(table: type[Table]) -> dict[str, Any]:
    """How point clouds on their way are written, which no user reads: 4-byte floats as they are, the rest in lz4.

    Measured coordinates are mostly noise: half as large again as in zstd, written and read in half of the time.
    """
    thorough = _writer_options(table)
    plain = {name for name, spec in columns_of(table).items() if spec.dtype == "f4" and not spec.shape}
    encoding = {
        leaf: "PLAIN" if leaf in plain else kind for leaf, kind in thorough["column_encoding"].items()
    }
    if table.PACKED:
        encoding |= {
            name: "BYTE_STREAM_SPLIT" for name, spec in columns_of(table).items() if spec.dtype == "u1"
        }
    leaves = [*encoding, *(thorough["use_dictionary"] or [])]
    return thorough | {
        "column_encoding": encoding,
        "compression": {leaf: "none" if leaf in plain else "lz4" for leaf in leaves},
        "compression_level": None,
        "write_statistics": False,
    }


def _footer(product: type[Product], attributes: Mapping[str, Any]) -> bytes:
    body = {
        "schema": product.NAME,
        "version": product.SCHEMA_VERSION,
        "columns": {name: dataclasses.asdict(spec) for name, spec in describe(product)},
        "attributes": attributes,
    }
    return json.dumps(body, sort_keys=True, separators=(",", ":")).encode()


def _read_footer(file: pq.ParquetFile, product: type[Product], path: Path) -> dict[str, Any]:
    raw = (file.metadata.metadata or {}).get(FOOTER_KEY)
    if raw is None:
        raise ProductError(
            f"not a {product.NAME} file: its footer has no description",
            where=str(path),
            next_step="give the file that the pipeline wrote",
        )
    footer: dict[str, Any] = json.loads(raw)
    _check_identity(product, footer.get("schema", ""), footer.get("version", 0), path)
    return footer


def _check_identity(product: type[Product], name: str, version: int, path: Path) -> None:
    if name != product.NAME or version != product.SCHEMA_VERSION:
        raise ProductError(
            f"holds {name or 'something'} version {version}, expected {product.NAME} version "
            f"{product.SCHEMA_VERSION}",
            where=str(path),
            next_step="run the stage that writes it again",
        )


def _damaged(path: Path, error: Exception) -> ProductError:
    return ProductError(
        f"cannot be read: {error}",
        where=str(path),
        next_step="run `scanloom verify`; it drops damaged artifacts so that the next run makes them anew",
    )


class _NamingDamage:
    """Turns read errors of Arrow into a `ProductError` that names the file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (OSError, ValueError, KeyError, pa.ArrowException)) and not isinstance(
            error, ProductError
        ):
            raise _damaged(self.path, error) from error
