"""Fixtures of the engine's tests: a store, and workers that find the toy workflow."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from scanloom.pipeline.store import Store

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True, scope="session")
def _importable_by_workers():
    """`tests.pipeline.toys` must be importable here and in every worker."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([before] if before else [])])
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    yield
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")
