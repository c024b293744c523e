"""What every stage promises: output as declared, same input same bytes, empty input a clear error, no sight of truth."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import pytest

from scanloom.pipeline.node import Node
from scanloom.pipeline.task import imported
from scanloom.schemas.cameras import Cameras
from scanloom.schemas.errors import ScanloomError
from scanloom.schemas.product import Document, Files, Part, Parts, Product, Stream, Table, attributes_of
from scanloom.schemas.rig import SensorCheck
from scanloom.schemas.session import Session, TruthLog
from scanloom.schemas.trajectory import Truth
from scanloom.schemas.windows import Window
from scanloom.workflows.map_session import NODES
from tests.mapped import Mapped, map_small, track_in_windows

every_node = pytest.mark.parametrize("node", NODES, ids=lambda n: n.name)

WITHOUT_INPUT = {"simulate"}
"""Makes its own input."""

CONTENT_WITH_NOTHING = {
    "base",
    "changes",
    "images",
    "camera_check",
    "colour",
    "brightness",
    "truth",
    "overview",
    "tiles",
    "evaluation",
    "picture",
    "report",
    "loops",
    "tiling",
    "deskew",
    "denoise",
    "places",
    "sensors",
    "windows",
    "objects",
    "rays",
    "relabel",
}
"""May answer emptiness with an empty product (no truth, no images, no windows, no tiles, no loops) instead of an error."""


@pytest.fixture(scope="module")
def first(small: Mapped, tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    """The small session, mapped at once and in windows."""
    return track_in_windows(small, tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def again(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    """The same session in another store, by two worker processes."""
    mapped = map_small(tmp_path_factory.mktemp("again"), cluster="local", workers=2)
    return track_in_windows(mapped, tmp_path_factory.mktemp("windows"), cluster="local", workers=2)


@every_node
def test_output_fits_the_declaration(node: Node, first: Mapped) -> None:
    artifacts = list(first.store.artifacts(node.name))
    assert artifacts
    for artifact in artifacts:
        written = {part.product for part in artifact.parts}
        assert written <= {product.NAME for product in node.writes}
        for product in node.writes:
            for part in artifact.of(product):
                opened = product.open(artifact.path(part))
                if isinstance(opened, Stream):
                    assert len(list(opened)) == part.rows
                elif isinstance(opened, Table):
                    assert len(opened) == part.rows


@every_node
def test_same_input_same_bytes(node: Node, first: Mapped, again: Mapped) -> None:
    made = {a.key: [p.to_json() for p in a.parts] for a in first.store.artifacts(node.name)}
    remade = {a.key: [p.to_json() for p in a.parts] for a in again.store.artifacts(node.name)}
    assert made and made == remade


@every_node
def test_empty_input_gives_a_clear_error(node: Node, tmp_path: Path) -> None:
    if node.name in WITHOUT_INPUT:
        pytest.skip("makes its own input")
    error = _refusal(node, tmp_path)
    if error is None:
        assert node.name in CONTENT_WITH_NOTHING, "an empty input must be refused"
    else:
        assert len(error.what) > 10 and error.next_step, f"{error!r} says too little"


def _refusal(node: Node, folder: Path) -> ScanloomError | None:
    """What a stage says of empty inputs; None when it takes them and its products can be written."""
    try:
        returned = node.stage(node.settings(), *_empty_inputs(node))
        made = list(returned) if inspect.isgenerator(returned) else [returned]
        for i, product in enumerate(
            p for item in made for p in (item if isinstance(item, tuple) else (item,))
        ):
            (product.product if isinstance(product, Part) else product).write(folder / f"{i}")
    except ScanloomError as error:
        return error
    return None


@every_node
def test_runs_anywhere(node: Node) -> None:
    path = f"{node.stage.__module__}:{node.stage.__qualname__}"
    assert imported(path) is node.stage


def test_no_stage_but_evaluation_sees_truth() -> None:
    assert {n.name for n in NODES if Truth in n.reads} == {"evaluation"}
    assert {n.name for n in NODES if TruthLog in n.reads} == {"truth"}


def test_the_raw_log_of_the_sample_holds_no_truth(small: Mapped) -> None:
    (artifact,) = small.store.artifacts("simulate")
    names = [f.path for part in artifact.parts if part.product == "raw_log" for f in part.files]
    assert sorted(Path(name).suffix for name in names) == [".mcap", ".yaml"]
    assert not any(b"truth" in artifact.folder.joinpath(name).read_bytes() for name in names)


def test_identity_names_everything_a_result_depends_on(first: Mapped) -> None:
    for node in NODES:
        for artifact in first.store.artifacts(node.name):
            identity = json.loads(json.dumps(artifact.identity))
            assert set(identity["settings"]) == set(node.settings.model_fields)
            assert identity["code"] and "inputs" in identity


def _empty_inputs(node: Node) -> list[Any]:
    writers = {product: n for n in NODES for product in n.writes}
    return [_empty(product, writers.get(product), node) for product in node.reads]


def _empty(product: type[Product], writer: Node | None, reader: Node) -> Any:
    """What the engine would hand over, with nothing in it."""
    axes = set(writer.axes) | ({product.SPLIT_BY} if product.SPLIT_BY else set()) if writer else {"session"}
    if not axes <= set(reader.axes):
        return Parts([])
    return _nothing(product)


def _nothing(product: type[Product]) -> Product:
    if issubclass(product, Files):
        return product()
    if issubclass(product, Stream):
        return product([])
    if product in (SensorCheck, Cameras):
        return product()
    if product is Window:
        return Window(first=0, own=0, last=0)
    if issubclass(product, Document):
        assert product is Session
        return Session(
            name="nothing", format="mcap", start_ns=0, end_ns=0, scan_count=0, point_count=0, scan_rate_hz=0.0,
            beams=0, point_time="none", topics=(), extrinsics=(), problems=(), complete=True,
        )  # fmt: skip
    assert issubclass(product, Table)
    return product.empty(**_blank_attributes(product))


def _blank_attributes(product: type[Table]) -> dict[str, Any]:
    blanks = {
        "frame": "map",
        "georeference": None,
        "source": "none",
        "sessions": (),
        "warnings": (),
        "remarks": (),
        "remnants": 0,
        "offset_m": (0.0, 0.0, 0.0),
    }
    return {name: blanks.get(name, 0.1) for name in attributes_of(product)}
