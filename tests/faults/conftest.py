"""Fault tests run the toy workflow of the engine's tests."""

from tests.pipeline.conftest import _importable_by_workers, store

__all__ = ["_importable_by_workers", "store"]
