"""Fingerprints: a change of what a stage uses changes its key, and nothing else does."""

from __future__ import annotations

import importlib
import os
import sys
import textwrap
from pathlib import Path

import pytest

from scanloom.pipeline.fingerprint import (
    FileHashes,
    _closure,
    _file_of,
    _imports,
    _module_source,
    canonical,
    code_version,
    digest,
    file_digest,
)
from scanloom.schemas.errors import InvalidInput
from tests.pipeline.toys.smooth import smooth

PACKAGE = {
    "__init__.py": "",
    "stage.py": """
        from plant.tools import near
        from .tools import nested
        def work(settings):
            from plant.late import word
            import numpy as np
            return word
    """,
    "late.py": "word = 1",
    "tools/__init__.py": "",
    "tools/near.py": "import scipy.spatial",
    "tools/nested.py": "from . import deep",
    "tools/deep.py": "x = 1",
    "tools/other.py": "y = 1",
    "unrelated.py": "z = 1",
}


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    for name, text in PACKAGE.items():
        path = tmp_path / "plant" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    return tmp_path / "plant"


def fingerprint(plant: Path) -> dict:
    """As a new process would see it: code is looked at once per process."""
    for memory in (_closure, _imports, _file_of, _module_source):
        memory.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "plant"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(plant.parent)
        return code_version(importlib.import_module("plant.stage").work, 1)


def test_closure_of_imports(plant):
    found = fingerprint(plant)
    names = ["plant", "plant.late", "plant.stage", "plant.tools", "plant.tools.deep", "plant.tools.near"]
    assert list(found["modules"]) == [*names, "plant.tools.nested"]
    assert list(found["libraries"]) == ["numpy", "scipy"]
    before = digest(found)

    (plant / "unrelated.py").write_text("z = 2")
    (plant / "tools" / "other.py").write_text("y = 2")
    assert digest(fingerprint(plant)) == before
    for name in ("late.py", "tools/deep.py", "tools/__init__.py"):
        (plant / name).write_text("x = 2")
        after = digest(fingerprint(plant))
        assert after != before, name
        before = after


def test_closure_reaches_the_products_of_a_toy_stage():
    modules = code_version(smooth, 1)["modules"]
    assert {"tests.pipeline.toys.helper", "tests.pipeline.toys.products", "scanloom.schemas.product"} <= set(
        modules
    )
    assert "tests.pipeline.toys.cut" not in modules
    assert not any(name.startswith("scanloom.pipeline") for name in modules)
    assert code_version(smooth, 2) != code_version(smooth, 1)


def test_canonical_json_has_one_form():
    assert canonical({"b": 1, "a": [1.5, None, "é"]}) == '{"a":[1.5,null,"é"],"b":1}'.encode()
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})


def test_file_hashes_are_remembered_until_the_file_changes(tmp_path, monkeypatch):
    file = tmp_path / "log.bag"
    file.write_bytes(b"one")
    hashes = FileHashes(tmp_path / "hashes.sqlite")
    first = hashes.of({"x": file})
    assert first == {"x": file_digest(file)}

    def refuse(path: Path) -> str:
        raise AssertionError

    with monkeypatch.context() as patch:
        patch.setattr("scanloom.pipeline.fingerprint.file_digest", refuse)
        assert FileHashes(tmp_path / "hashes.sqlite").of({"x": file}) == first
    file.write_bytes(b"two")
    os.utime(file, ns=(1, 1))
    assert hashes.of({"x": file}) != first


def test_file_hashes_work_without_memory(tmp_path):
    file = tmp_path / "log.bag"
    file.write_bytes(b"one")
    damaged = tmp_path / "hashes.sqlite"
    damaged.write_bytes(b"not a database" * 100)
    assert FileHashes(damaged).of({"x": file}) == {"x": file_digest(file)}
    with pytest.raises(InvalidInput, match=r"absent\.bag: cannot be read: No such file"):
        FileHashes(damaged).of({"x": tmp_path / "absent.bag"})
