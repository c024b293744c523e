"""Points as binary glTF 2.0: column after column, since some readers know no interleaved ones. A library would only wrap `struct`.

Metadata follow 3D Tiles 1.1: EXT_structural_metadata says what the attributes mean.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERTEX = np.dtype(
    [
        ("position", "<f4", 3),
        ("colour", "u1", 4),
        ("intensity", "<f4"),
        ("class", "u1", 4),
        ("normal", "i1", 4),
        ("session", "<u2", 2),
    ]
)
"""What is written of a point, 32 bytes. Elements of glTF start at multiples of four, so class, normal and session have
padding behind them."""
_FLOAT, _BYTE, _UNSIGNED_BYTE, _UNSIGNED_SHORT = 5126, 5120, 5121, 5123
_ARRAY_BUFFER, _POINTS = 34962, 0
_COLUMNS = (
    ("POSITION", "position", _FLOAT, "VEC3"),
    ("COLOR_0", "colour", _UNSIGNED_BYTE, "VEC4"),
    ("_INTENSITY", "intensity", _FLOAT, "SCALAR"),
    ("_CLASSIFICATION", "class", _UNSIGNED_BYTE, "SCALAR"),
    ("_NORMAL", "normal", _BYTE, "VEC3"),
    ("_SESSION", "session", _UNSIGNED_SHORT, "SCALAR"),
)
"""Attribute, field, type of a component, type of an element."""
_NORMALIZED = ("COLOR_0", "_NORMAL")
_CLASS = {
    "name": "Point",
    "properties": {
        "intensity": {"type": "SCALAR", "componentType": "FLOAT32", "description": "mean of the voxel's points"},
        "classification": {"type": "SCALAR", "componentType": "UINT8", "description": "1 ground, 2 static"},
        "session": {"type": "SCALAR", "componentType": "UINT16", "description": "session that met it first"},
    },
}  # fmt: skip
_ATTRIBUTES = {"intensity": "_INTENSITY", "classification": "_CLASSIFICATION", "session": "_SESSION"}


def glb(vertices: NDArray[Any], centre_m: tuple[float, float, float]) -> bytes:
    """A file of vertices (n,) of dtype `VERTEX`, n > 0, positions from `centre_m`; axes are those of the map, z up.

    glTF has y up, and readers of 3D Tiles turn it back: (x, y, z) of the map is (x, z, -y) there. The turn stands in the
    node's matrix, so positions stay as they were measured.
    """
    x, y, z = centre_m
    binary = b"".join(np.ascontiguousarray(vertices[field]).tobytes() for _, field, _, _ in _COLUMNS)
    body: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "scanloom"},
        "extensionsUsed": ["EXT_structural_metadata", "KHR_materials_unlit"],
        "extensions": {
            "EXT_structural_metadata": {
                "schema": {"id": "scanloom", "classes": {"point": _CLASS}},
                "propertyAttributes": [
                    {
                        "class": "point",
                        "properties": {name: {"attribute": a} for name, a in _ATTRIBUTES.items()},
                    }
                ],
            }
        },
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]}],
        "meshes": [{"primitives": [_primitive()]}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": _views(len(vertices)),
        "accessors": _accessors(vertices),
    }
    text = json.dumps(body, separators=(",", ":")).encode()
    return _container(text + b" " * (-len(text) % 4), binary + b"\0" * (-len(binary) % 4))


def _primitive() -> dict[str, Any]:
    return {
        "mode": _POINTS,
        "material": 0,
        "attributes": {name: number for number, (name, *_) in enumerate(_COLUMNS)},
        "extensions": {"EXT_structural_metadata": {"propertyAttributes": [0]}},
    }


def _views(count: int) -> list[dict[str, Any]]:
    """Where each column stands in the buffer."""
    views: list[dict[str, Any]] = []
    first = 0
    for _, field, _, _ in _COLUMNS:
        stride = VERTEX[field].itemsize
        views.append(
            {
                "buffer": 0, "byteOffset": first, "byteLength": stride * count, "byteStride": stride, "target": _ARRAY_BUFFER,
            }
        )  # fmt: skip
        first += stride * count
    return views


def _accessors(vertices: NDArray[Any]) -> list[dict[str, Any]]:
    made: list[dict[str, Any]] = []
    for number, (name, _, component, kind) in enumerate(_COLUMNS):
        entry = {"bufferView": number, "componentType": component, "type": kind, "count": len(vertices)}
        made.append(entry | {"normalized": True} if name in _NORMALIZED else entry)
    position = vertices["position"]
    made[0] |= {"min": position.min(axis=0).tolist(), "max": position.max(axis=0).tolist()}
    return made


def _container(text: bytes, binary: bytes) -> bytes:
    """The binary form: a header, a chunk of JSON, a chunk of bytes."""
    total = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<4sII", b"glTF", 2, total)
    return b"".join(
        (
            head,
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        )
    )
