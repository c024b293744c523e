"""A line of the workflow table: which stage, at what fan-out, reading and writing what."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from scanloom.schemas.errors import UsageError
from scanloom.schemas.product import Product

AXES: dict[str, tuple[str, ...]] = {
    "map": (),
    "session": ("session",),
    "chunk": ("session", "chunk"),
    "window": ("session", "window"),
    "submap": ("session", "submap"),
    "footage": ("session", "footage"),
    "tile": ("tile",),
    "pair": ("pair",),
}
"""Axes along which each `per` fans out. A part of a product stands at the axes of the task that wrote it,
plus the axis it is split along (`SPLIT_BY`). A task reads the parts that agree with it on the axes both have:
a single product when the part has no axis the task lacks, else `Parts`, ordered."""


ALONE = frozenset({"session", "map"})
"""Fan-outs of which few tasks run at a time, so that cores are free for reading ahead and writing behind. Where tasks are
as many as cores, those threads only get in each other's way."""


@dataclass(frozen=True)
class Node:
    """One stage of a workflow. `settings` and `version` come from the stage's module."""

    name: str
    stage: Callable[..., Any]
    per: str
    reads: tuple[type[Product], ...]
    writes: tuple[type[Product], ...]
    settings: type[BaseModel]
    version: int
    title: str
    settings_of: str
    """Stage under whose name its settings stand: itself, or another one."""
    only: str | None = None
    """Runs for sessions with this tag only (for instance `simulated`)."""
    resources: tuple[tuple[str, float], ...] = ()
    """What a worker must offer, for instance (("GPU", 1),)."""

    @property
    def axes(self) -> tuple[str, ...]:
        return AXES[self.per]


def node(
    name: str,
    stage: Callable[..., Any],
    *,
    per: str,
    reads: tuple[type[Product], ...] = (),
    writes: type[Product] | tuple[type[Product], ...],
    title: str = "",
    settings: str = "",
    only: str | None = None,
    resources: Mapping[str, float] | None = None,
) -> Node:
    """Declare a line of a workflow.

    `stage(settings, *products)` gets its products in the order of `reads`, and returns a product, a tuple of products,
    or an iterator of products and `Part`s; each is written before the next is asked for. With `settings`, its own
    are those of the stage of that name, as far as its `Settings` has them: they are set there, for both.

    Raises
    ------
    UsageError : `per` is unknown, or the stage's module has no `Settings` or no `VERSION`.
    """
    if per not in AXES:
        raise UsageError(f"node {name}: per={per!r} is none of {', '.join(AXES)}")
    module = sys.modules[stage.__module__]
    try:
        model, version = module.Settings, module.VERSION
    except AttributeError as error:
        raise UsageError(f"node {name}: module {stage.__module__} lacks Settings or VERSION") from error
    outputs = writes if isinstance(writes, tuple) else (writes,)
    needs = tuple(sorted((resources or {}).items()))
    return Node(
        name, stage, per, reads, outputs, model, version, title or name, settings or name, only, needs
    )
