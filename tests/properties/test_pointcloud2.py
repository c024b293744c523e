"""PointCloud2 of any layout: random field order, types, gaps, byte order, row padding, organised or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.logs.pointcloud import decode_pointcloud2
from scanloom.stages.logs.records import PointCloud2, PointField

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
STAMP_NS = 1_700_000_000_123_456_789


@dataclass(frozen=True)
class Layout:
    """How a driver could store its points."""

    fields: tuple[tuple[str, str], ...]
    gaps: tuple[int, ...]
    tail: int
    row_padding: int
    height: int
    width: int
    big: bool
    extra_bytes: int


@st.composite
def layouts(draw: st.DrawFn) -> Layout:
    coordinate = draw(st.sampled_from(["f4", "f8"]))
    fields = [("x", coordinate), ("y", coordinate), ("z", coordinate)]
    if draw(st.booleans()):
        name = draw(st.sampled_from(["intensity", "i", "reflectivity", "signal", "Intensity"]))
        fields.append((name, draw(st.sampled_from(["u1", "u2", "f4", "u4"]))))
    if draw(st.booleans()):
        fields.append(
            (draw(st.sampled_from(["ring", "channel", "line"])), draw(st.sampled_from(["u1", "u2", "i4"])))
        )
    if draw(st.booleans()):
        fields.append(
            draw(st.sampled_from([("time", "f4"), ("t", "u4"), ("timestamp", "f8"), ("offset_time", "u4")]))
        )
    if draw(st.booleans()):
        fields.append(("unheard_of", draw(st.sampled_from(list(CODES)))))
    fields = draw(st.permutations(fields))
    return Layout(
        fields=tuple(fields),
        gaps=tuple(draw(st.integers(0, 5)) for _ in fields),
        tail=draw(st.integers(0, 9)),
        row_padding=draw(st.integers(0, 7)),
        height=draw(st.integers(1, 4)),
        width=draw(st.integers(1, 20)),
        big=draw(st.booleans()),
        extra_bytes=draw(st.integers(0, 3)),
    )


def build(layout: Layout, seed: int) -> tuple[PointCloud2, dict[str, np.ndarray]]:
    """A message of the layout, and the values put into it, written byte by byte without numpy's structured types."""
    rng = np.random.default_rng(seed)
    offsets, end = [], 0
    for (_, kind), gap in zip(layout.fields, layout.gaps):
        offsets.append(end + gap)
        end += gap + np.dtype(kind).itemsize
    step = end + layout.tail
    count = layout.height * layout.width
    padding = layout.row_padding if layout.height > 1 else 0
    values = {name: random_values(rng, name, kind, count) for name, kind in layout.fields}
    order = ">" if layout.big else "<"
    data = bytearray()
    for row in range(layout.height):
        for column in range(layout.width):
            point = bytearray(rng.bytes(step))
            for (name, kind), offset in zip(layout.fields, offsets):
                raw = np.array([values[name][row * layout.width + column]], order + kind).tobytes()
                point[offset : offset + len(raw)] = raw
            data += point
        data += rng.bytes(padding)
    data += rng.bytes(layout.extra_bytes)
    fields = tuple(PointField(n, o, CODES[k], 1) for (n, k), o in zip(layout.fields, offsets))
    message = PointCloud2(
        stamp_ns=STAMP_NS, receive_ns=STAMP_NS, frame_id="lidar", height=layout.height, width=layout.width, fields=fields,
        is_bigendian=layout.big, point_step=step, row_step=step * layout.width + padding,
        data=np.frombuffer(bytes(data), np.uint8), is_dense=False,
    )  # fmt: skip
    return message, values


def random_values(rng: np.random.Generator, name: str, kind: str, count: int) -> np.ndarray:
    """Times fill a sweep of 0.1 s in the driver's own unit; coordinates hold a NaN and a zero now and then."""
    share = np.linspace(0, 0.0999, count) if count > 1 else np.zeros(1)
    if name == "time":
        return share.astype(kind)
    if name in ("t", "offset_time"):
        return (share * 1e9).astype(kind)
    if name == "timestamp":
        return (share + STAMP_NS * 1e-9).astype(kind)
    if np.dtype(kind).kind == "f":
        values = rng.normal(0, 30, count).astype(kind)
        values[rng.random(count) < 0.1] = np.nan
        values[rng.random(count) < 0.1] = 0
        return values
    return rng.integers(0, 64, count).astype(kind)


@settings(max_examples=150, deadline=None)
@given(layouts(), st.integers(0, 2**32 - 1))
def test_every_layout_gives_the_values_put_in(layout: Layout, seed: int) -> None:
    message, values = build(layout, seed)
    cloud = decode_pointcloud2(message)
    for axis, column in zip("xyz", (cloud.x_m, cloud.y_m, cloud.z_m)):
        np.testing.assert_array_equal(column, values[axis].astype(np.float32))
    for name, decoded in values.items():
        if name.lower() in ("intensity", "i", "reflectivity", "signal"):
            np.testing.assert_array_equal(cloud.intensity, decoded.astype(np.float32))
        if name in ("time", "t", "offset_time", "timestamp"):
            assert cloud.time_ns is not None
            share = np.linspace(0, 0.0999, len(decoded)) if len(decoded) > 1 else np.zeros(1)
            # A float32 of 0.1 s is good to 7 ns, a double of seconds since 1970 to 240 ns.
            assert np.abs(cloud.time_ns - STAMP_NS - share * 1e9).max() < (300 if name == "timestamp" else 10)
    if not {"time", "t", "offset_time", "timestamp"} & set(values):
        assert cloud.time_ns is None
    ring = next((name for name in ("ring", "channel", "line") if name in values), None)
    if ring and "numbered from above" not in cloud.remark:
        np.testing.assert_array_equal(cloud.ring, values[ring].astype(np.uint16))
    assert len(cloud.ring) == len(cloud.return_no) == layout.height * layout.width


@settings(max_examples=60, deadline=None)
@given(layouts(), st.integers(0, 2**32 - 1), st.data())
def test_a_message_cut_short_is_refused_by_name(layout: Layout, seed: int, data: st.DataObject) -> None:
    message, _ = build(layout, seed)
    last = message.row_step * (message.height - 1) + message.width * message.point_step
    kept = data.draw(st.integers(0, last - 1))
    with pytest.raises(InvalidInput, match="data has"):
        decode_pointcloud2(PointCloud2(**{**vars(message), "data": message.data[:kept]}))


@settings(max_examples=60, deadline=None)
@given(layouts(), st.integers(0, 2**32 - 1), st.data())
def test_a_damaged_header_never_gives_another_error(layout: Layout, seed: int, data: st.DataObject) -> None:
    """Any sizes, datatypes and offsets: either points come out, or an InvalidInput that names the field."""
    message, _ = build(layout, seed)
    number = st.one_of(st.integers(0, 300), st.integers(0, 2**32 - 1))
    size = st.integers(0, 300)
    changed = dict(vars(message))
    for key in data.draw(
        st.sets(st.sampled_from(["height", "width", "point_step", "row_step", "fields"]), min_size=1)
    ):
        if key == "fields":
            changed[key] = tuple(
                PointField(f.name, data.draw(size), data.draw(st.integers(0, 12)), f.count)
                for f in message.fields
            )
        else:
            changed[key] = data.draw(size if key == "height" else number)
    try:
        cloud = decode_pointcloud2(PointCloud2(**changed))
    except InvalidInput as refusal:
        what = refusal.what
    else:
        assert len(cloud.x_m) == changed["height"] * changed["width"]
        return
    assert any(word in what for word in ("row_step", "point_step", "data has", "field", "datatype"))
