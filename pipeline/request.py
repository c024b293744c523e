"""What a run is asked for, and whether it fits together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

from scanloom.pipeline.node import AXES, Node
from scanloom.pipeline.settings import resolve
from scanloom.pipeline.store import RESERVED
from scanloom.schemas.errors import UsageError
from scanloom.schemas.product import Files, Product

FIXED = ("map", "session")
"""Fan-outs that are known before anything ran."""


@dataclass(frozen=True)
class SessionInput:
    """One log of a request."""

    name: str
    """Unique in the request; letters, digits, `.`, `_`, `-`."""
    sources: Mapping[type[Product], Files]
    """Existing files outside the store, by the product they are."""
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """{stage: {field: value}} for tasks of this session."""
    tags: frozenset[str] = frozenset()
    """Nodes with `only` run for sessions with that tag."""


@dataclass(frozen=True)
class Request:
    """What to compute: a workflow, its sessions, and settings over the defaults."""

    nodes: tuple[Node, ...]
    sessions: tuple[SessionInput, ...]
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def part_axes(product: type[Product], writer: Node) -> tuple[str, ...]:
    """Axes of the parts of a product: the writer's, plus the one it is split along."""
    split = product.SPLIT_BY
    return writer.axes if split is None or split in writer.axes else (*writer.axes, split)


def writers_of(nodes: Sequence[Node]) -> dict[type[Product], Node]:
    writers: dict[type[Product], Node] = {}
    names: set[str] = set()
    for node in nodes:
        if node.name in names or node.name in RESERVED:
            raise UsageError(f"node name {node.name} is taken", next_step="give it another name")
        names.add(node.name)
        if node.only is not None and "session" not in node.axes:
            raise UsageError(f"node {node.name} has `only` but runs per {node.per}, not per session")
        for product in node.writes:
            if product in writers:
                raise UsageError(f"{product.NAME} is written by {writers[product].name} and by {node.name}")
            writers[product] = node
    return writers


def ordered(nodes: Sequence[Node], writers: Mapping[type[Product], Node]) -> tuple[Node, ...]:
    """Writers before readers; otherwise as declared."""
    done: dict[str, Node] = {}
    active: set[str] = set()

    def visit(node: Node) -> None:
        if node.name in done:
            return
        if node.name in active:
            raise UsageError(f"node {node.name} reads what depends on what it writes")
        active.add(node.name)
        for product in node.reads:
            if product in writers:
                visit(writers[product])
        done[node.name] = node

    for node in nodes:
        visit(node)
    return tuple(done.values())


def check_sessions(request: Request, nodes: Sequence[Node], writers: Mapping[type[Product], Node]) -> None:
    names = [session.name for session in request.sessions]
    if not names and any("session" in node.axes for node in nodes):
        raise UsageError("no session is given", next_step="name at least one")
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"session name {name} is used twice", next_step="name the sessions apart")
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
            raise UsageError(f"session name {name!r} must be letters, digits, `.`, `_` or `-`")
    for node in nodes:
        if node.per not in FIXED and not any(
            product in writers and set(AXES[node.per]) <= set(part_axes(product, writers[product]))
            for product in node.reads
        ):
            raise UsageError(f"node {node.name} runs per {node.per} but reads nothing that is split so")
        for product in node.reads:
            _check_provided(node, product, request.sessions, writers)


def _check_provided(
    node: Node,
    product: type[Product],
    sessions: Sequence[SessionInput],
    writers: Mapping[type[Product], Node],
) -> None:
    writer = writers.get(product)
    if writer is not None and writer.only is None:
        return
    for session in sessions:
        applies = node.only is None or node.only in session.tags
        made = writer is not None and writer.only in session.tags
        if applies and not made and product not in session.sources:
            raise UsageError(
                f"session {session.name} brings no {product.NAME}, which {node.name} reads",
                next_step=f"give its {product.NAME}",
            )


def session_settings(request: Request, session: SessionInput) -> dict[str, BaseModel]:
    of_the_map = {node.settings_of for node in request.nodes if "session" not in node.axes}
    for stage in session.settings:
        if stage in of_the_map:
            raise UsageError(
                f"stage {stage} runs for the whole map, so one session cannot set it",
                where=f"session {session.name}",
                next_step="set it for all sessions",
            )
    layers = [("settings", request.settings), (f"session {session.name}", session.settings)]
    return resolve(request.nodes, layers)
