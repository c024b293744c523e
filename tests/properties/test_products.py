"""Every table and stream of the schemas: what is written is what is read, and nothing else can be."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import scanloom.schemas
from scanloom.schemas.errors import ProductError
from scanloom.schemas.product import (
    STRING,
    Column,
    Product,
    Stream,
    Table,
    attributes_of,
    columns_of,
    describe,
)


def products(base: type[Product]) -> list[type[Any]]:
    """All products of a kind, found by importing every module of the schemas."""
    for module in pkgutil.iter_modules(scanloom.schemas.__path__):
        importlib.import_module(f"scanloom.schemas.{module.name}")
    found: dict[str, type[Any]] = {}
    pending = list(base.__subclasses__())
    while pending:
        kind = pending.pop()
        pending.extend(kind.__subclasses__())
        if kind.__module__.startswith("scanloom.schemas") and hasattr(kind, "NAME"):
            found[kind.__name__] = kind
    return [found[name] for name in sorted(found)]


TABLES = products(Table)
STREAMS = products(Stream)

quick = settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def values(spec: Column, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Any bits that the column's type can hold, NaN and infinities included."""
    shape = (rows, *spec.shape)
    if spec.dtype == STRING:
        words = ["", "plain", "späte Wörter", "with\nline", "\U0001f6f0", "x" * 300]
        return np.array([words[i] for i in rng.integers(0, len(words), rows)], dtype=object)
    dtype = np.dtype(spec.dtype)
    if dtype.kind == "b":
        return rng.random(shape) < 0.5
    bits = rng.integers(0, 256, size=(rows, spec.width * dtype.itemsize), dtype=np.uint8)
    return bits.view(dtype).reshape(shape).copy()


def attributes(table: type[Table], rng: np.random.Generator) -> dict[str, Any]:
    hints = get_type_hints(table)
    made: dict[str, Any] = {}
    for name in attributes_of(table):
        hint = str(hints[name])
        if hints[name] is int:
            made[name] = int(rng.integers(-(2**62), 2**62))
        elif hints[name] is float:
            made[name] = float(rng.normal())
        elif hints[name] is str:
            made[name] = str(rng.choice(["world", "map", "ü"]))
        elif "dict" in hint:
            made[name] = None if rng.random() < 0.5 else {"epsg": 32632, "point_scale": 0.9996}
        elif "float" in hint:
            made[name] = (1.5, -2.25, 1e9)
        else:
            made[name] = ("a", "b")
    return made


def random_table(table: type[Table], rows: int, seed: int) -> Table:
    rng = np.random.default_rng(seed)
    columns = {name: values(spec, rows, rng) for name, spec in columns_of(table).items()}
    return table(**columns, **attributes(table, rng))


def assert_same(a: Table, b: Table) -> None:
    for name in columns_of(type(a)):
        ours, theirs = getattr(a, name), getattr(b, name)
        assert ours.dtype == theirs.dtype
        assert ours.shape == theirs.shape
        if ours.dtype == object:
            assert ours.tolist() == theirs.tolist()
        else:
            assert ours.tobytes() == theirs.tobytes(), name
    for name in attributes_of(type(a)):
        ours, theirs = getattr(a, name), getattr(b, name)
        assert theirs == (list(ours) if isinstance(theirs, list) else ours), name


def test_the_schemas_hold_the_products_of_the_design() -> None:
    names = {table.NAME for table in TABLES} | {stream.NAME for stream in STREAMS}
    wanted = {
        "scans",
        "deskewed",
        "labels",
        "imu",
        "gnss",
        "wheel",
        "odometry",
        "places",
        "loops",
        "graph",
        "poses",
        "truth",
    }
    assert wanted <= names
    assert len(names) == len(TABLES) + len(STREAMS), "two products share a name"


@pytest.mark.parametrize("product", [*TABLES, *STREAMS], ids=lambda p: p.__name__)
def test_every_column_says_what_it_is(product: type[Product]) -> None:
    for name, spec in describe(product):
        assert spec.doc, f"{name} has no meaning"
        assert spec.dtype == STRING or np.dtype(spec.dtype).kind in "iufb"
        if name.endswith("_m"):
            assert spec.unit == "m"
        if name.endswith("_ns"):
            assert (spec.unit, spec.dtype) == ("ns", "i8")


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.__name__)
@quick
@given(rows=st.integers(0, 40), seed=st.integers(0, 2**32 - 1))
def test_a_table_comes_back_bit_by_bit(table: type[Table], rows: int, seed: int, tmp_path: Path) -> None:
    made = random_table(table, rows, seed)
    path = tmp_path / "table.parquet"
    assert made.write(path) == rows
    assert_same(made, table.open(path))


@pytest.mark.parametrize("stream", STREAMS, ids=lambda s: s.__name__)
@quick
@given(sizes=st.lists(st.integers(0, 30), max_size=4), seed=st.integers(0, 2**32 - 1))
def test_a_stream_comes_back_item_by_item(
    stream: type[Any], sizes: list[int], seed: int, tmp_path: Path
) -> None:
    items = [random_table(stream.ITEM, rows, seed + i) for i, rows in enumerate(sizes)]
    path = tmp_path / "stream.parquet"
    assert stream(iter(items)).write(path) == len(items)
    back = stream.open(path)
    assert [entry["rows"] for entry in back.index] == sizes
    for item, again in zip(items, back, strict=True):
        assert_same(item, again)
    for i in reversed(range(len(items))):
        assert_same(items[i], back[i])


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.__name__)
def test_the_same_table_gives_the_same_bytes(table: type[Table], tmp_path: Path) -> None:
    for name in ("a", "b"):
        random_table(table, 25, 7).write(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.__name__)
def test_wrong_types_shapes_and_lengths_are_refused(table: type[Table]) -> None:
    made = random_table(table, 3, 1)
    for name, spec in columns_of(table).items():
        good = getattr(made, name)
        other = np.zeros(good.shape, np.complex64)
        for wrong in (other, good[:, None], good.tolist()):
            with pytest.raises(ProductError, match=name):
                dataclasses.replace(made, **{name: wrong})
        if spec.shape:
            with pytest.raises(ProductError, match=name):
                dataclasses.replace(made, **{name: good.reshape(len(good), -1)[:, :1]})
    if len(columns_of(table)) > 1:
        last = list(columns_of(table))[-1]
        with pytest.raises(ProductError, match="rows"):
            dataclasses.replace(made, **{last: getattr(made, last)[:2]})
