"""Which tasks exist, which may start, what they read: the fan-out of a workflow over sessions, chunks and tiles.

The flow grows while it runs: how many chunks a session has is known when its ingest is done. It neither computes
nor reads files; `run` and `plan` drive it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from pydantic import BaseModel

from scanloom.pipeline.node import Node
from scanloom.pipeline.request import (
    FIXED,
    Request,
    SessionInput,
    check_sessions,
    ordered,
    part_axes,
    session_settings,
    writers_of,
)
from scanloom.pipeline.settings import resolve
from scanloom.pipeline.store import Artifact, StoredPart, part_coordinate
from scanloom.schemas.errors import ScanloomError
from scanloom.schemas.product import Coordinate, Product


@dataclass(frozen=True)
class Source:
    """Files outside the store that stand for a product of a session."""

    session: SessionInput
    product: type[Product]


Ref = tuple["Task", Artifact, StoredPart] | Source


@dataclass
class Input:
    """What a task gets for one product it reads."""

    product: type[Product]
    plain: bool
    parts: list[tuple[Coordinate, Ref]]


@dataclass(eq=False)
class Task:
    """A node at a coordinate."""

    node: Node
    coordinate: Coordinate
    settings: BaseModel
    state: str = "waiting"
    """`waiting`, `ready`, `done`, `failed` or `skipped`."""
    artifact: Artifact | None = None
    lost: frozenset[str] = frozenset()
    """Sessions that are missing from what this task was made of."""
    reason: str = ""
    key: str = ""

    @property
    def session(self) -> str | None:
        return dict(self.coordinate).get("session")

    @property
    def over(self) -> bool:
        return self.state in ("done", "failed", "skipped")

    def __str__(self) -> str:
        place = " ".join(f"{axis}={value}" for axis, value in self.coordinate)
        return f"{self.node.name} {place}".strip()


@dataclass
class Group:
    """Tasks of a node in one session, or all of them when the node has no session axis."""

    tasks: dict[Coordinate, Task] = field(default_factory=dict)
    enumerated: bool = False
    open: int = 0
    lost: frozenset[str] = frozenset()
    """Sessions whose failure kept tasks from existing."""

    @property
    def settled(self) -> bool:
        return self.enumerated and self.open == 0


class Flow:
    """The tasks of a request.

    Raises
    ------
    UsageError : the workflow or the sessions do not fit together, or a setting is wrong.
    """

    def __init__(self, request: Request) -> None:
        self.sessions = {session.name: session for session in request.sessions}
        self.writers = writers_of(request.nodes)
        self.nodes = ordered(request.nodes, self.writers)
        self.depth = {node.name: i for i, node in enumerate(self.nodes)}
        check_sessions(request, self.nodes, self.writers)
        self._readers = {n.name: [r for r in self.nodes if self._reads_from(r, n)] for n in self.nodes}
        self._common = resolve(self.nodes, [("settings", request.settings)])
        self._own = {s.name: session_settings(request, s) for s in request.sessions}
        self._applies = {node.name: _scopes(node, request.sessions) for node in self.nodes}
        self._groups: dict[tuple[str, str | None], Group] = {}
        for node in self.nodes:
            for scope in self._scopes(node):
                self._groups[node.name, scope] = Group()
        self._indexes: dict[
            tuple[type[Product], tuple[str, ...]], dict[Coordinate, list[tuple[Coordinate, Ref]]]
        ] = {}
        self._fresh: list[Task] = []
        for node in self.nodes:
            if node.per in FIXED:
                for scope in self._scopes(node):
                    self._enumerate(
                        node, scope, [() if scope is None else (("session", scope),)], frozenset()
                    )
        self._review(self.nodes)

    def tasks(self) -> Iterator[Task]:
        for group in self._groups.values():
            yield from group.tasks.values()

    def take(self) -> list[Task]:
        """Tasks that became ready or were skipped since the last call."""
        fresh, self._fresh = self._fresh, []
        return fresh

    def finish(self, task: Task, artifact: Artifact | None) -> None:
        """The task is done; None means that it failed."""
        self._conclude(task, "done" if artifact else "failed", artifact)
        self._review(self._readers[task.node.name], task)

    def group(self, node: Node, session: str | None) -> Group:
        return self._groups[node.name, session if "session" in node.axes else None]

    def groups(self, node: Node) -> list[tuple[str | None, Group]]:
        """Groups of a node: one per session, or one."""
        return [(scope, self._groups[node.name, scope]) for scope in self._scopes(node)]

    def settings(self, node: Node, session: str | None) -> BaseModel:
        return (self._own[session] if session is not None else self._common)[node.name]

    # --- who provides what ------------------------------------------------------------------------------------------

    def _scopes(self, node: Node) -> list[str | None]:
        return self._applies[node.name]

    def _reads_from(self, reader: Node, writer: Node) -> bool:
        return any(self.writers.get(product) is writer for product in reader.reads)

    def _provider(self, product: type[Product], session: str | None) -> Node | None:
        """Node that writes `product` for this session; None when the session brings it along."""
        writer = self.writers.get(product)
        if writer is None or writer.only is None or session is None:
            return writer
        return writer if (writer.name, session) in self._groups else None

    def providers(self, task: Task, product: type[Product]) -> list[tuple[Node | None, str | None]]:
        """(node, session) of everything that a task reads as `product`; node None stands for the session's files."""
        writer = self.writers.get(product)
        if task.session is not None:
            return [(self._provider(product, task.session), task.session)]
        if writer is not None and "session" not in writer.axes:
            return [(writer, None)]
        return [(self._provider(product, name), name) for name in self.sessions]

    # --- growth -----------------------------------------------------------------------------------------------------

    def _review(self, nodes: Iterable[Node], cause: Task | None = None) -> None:
        """Let tasks come into being, become ready or be skipped, until nothing changes."""
        pending = sorted(set(nodes), key=lambda n: self.depth[n.name])
        while pending:
            node = pending.pop(0)
            changed = False
            for scope in self._scopes(node):
                if cause is not None and scope is not None and cause.session not in (None, scope):
                    continue
                changed |= self._grow(node, scope)
                changed |= self._wake(node, scope)
            if changed:
                cause = None
                later = {*pending, *self._readers[node.name]}
                pending = sorted(later, key=lambda n: self.depth[n.name])

    def _grow(self, node: Node, scope: str | None) -> bool:
        """Enumerate the tasks of a dynamic node once that is possible; true when something changed."""
        group = self._groups[node.name, scope]
        if group.enumerated:
            return False
        places: set[Coordinate] = set()
        lost: frozenset[str] = frozenset()
        for product, writer in self._drivers(node):
            by_tasks = set(node.axes) <= set(writer.axes)
            for above in self._groups_of(writer, scope):
                if not (above.enumerated if by_tasks else above.settled):
                    return False
                lost |= above.lost
                if by_tasks:
                    places.update(_project(c, node.axes) for c in above.tasks)
                else:
                    lost |= _losses(above.tasks.values())
            if not by_tasks:
                for above in self._groups_of(writer, scope):
                    for coordinate, _ in _parts(product, above.tasks.values()):
                        if dict(coordinate).get("session") not in lost or scope is not None:
                            places.add(_project(coordinate, node.axes))
        self._enumerate(node, scope, sorted(places), lost)
        return True

    def _drivers(self, node: Node) -> list[tuple[type[Product], Node]]:
        """Products whose parts say where the tasks of a dynamic node are."""
        drivers = []
        for product in node.reads:
            writer = self.writers.get(product)
            if writer is not None and set(node.axes) <= set(part_axes(product, writer)):
                drivers.append((product, writer))
        return drivers

    def _groups_of(self, node: Node, session: str | None) -> list[Group]:
        if "session" in node.axes and session is None:
            return [self._groups[node.name, name] for name in self._scopes(node)]
        key = (node.name, session if "session" in node.axes else None)
        return [self._groups[key]] if key in self._groups else []

    def _enumerate(
        self, node: Node, scope: str | None, places: Iterable[Coordinate], lost: frozenset[str]
    ) -> None:
        group = self._groups[node.name, scope]
        for place in places:
            group.tasks[place] = Task(node, place, self.settings(node, scope))
        group.open = len(group.tasks)
        group.enumerated = True
        group.lost = lost

    def _wake(self, node: Node, scope: str | None) -> bool:
        """Mark tasks ready whose inputs are all known; skip those that lost theirs. True when a task was skipped."""
        skipped = False
        group = self._groups[node.name, scope]
        if not group.enumerated or not group.open:
            return False
        for task in group.tasks.values():
            if task.state == "waiting" and self._known(task):
                task.lost, reason = self._damage(task)
                if reason:
                    task.reason = reason
                    self._conclude(task, "skipped", None)
                    skipped = True
                else:
                    task.state = "ready"
                self._fresh.append(task)
        return skipped

    def _conclude(self, task: Task, state: str, artifact: Artifact | None) -> None:
        task.state = state
        task.artifact = artifact
        self.group(task.node, task.session).open -= 1

    def _known(self, task: Task) -> bool:
        """Is everything that the task reads over and done with?"""
        for product in task.node.reads:
            for writer, session in self.providers(task, product):
                if writer is None:
                    continue
                for group in self._groups_of(writer, session):
                    if set(writer.axes) <= set(task.node.axes):
                        exact = group.tasks.get(_project(task.coordinate, writer.axes))
                        if not (group.enumerated and (exact is None or exact.over)):
                            return False
                    elif not group.settled:
                        return False
        return True

    def above(self, task: Task, product: type[Product]) -> Iterator[Task]:
        """Tasks that write what `task` reads as `product`."""
        for writer, session in self.providers(task, product):
            for group in self._groups_of(writer, session) if writer is not None else []:
                if writer is not None and set(writer.axes) <= set(task.node.axes):
                    exact = group.tasks.get(_project(task.coordinate, writer.axes))
                    yield from [exact] if exact is not None else []
                else:
                    yield from group.tasks.values()

    def _damage(self, task: Task) -> tuple[frozenset[str], str]:
        """Sessions lost on the way to this task, and why it cannot run (empty when it can)."""
        lost: frozenset[str] = frozenset()
        for product in task.node.reads:
            for writer, session in self.providers(task, product):
                for group in self._groups_of(writer, session) if writer is not None else []:
                    lost |= group.lost
            for above in self.above(task, product):
                lost |= above.lost
                if above.state in ("failed", "skipped"):
                    if above.session is None:
                        return lost, f"{above} {above.state}"
                    lost |= {above.session}
        own = task.session
        if own is not None and own in lost:
            return lost, self._cause(task, own)
        if own is None and self.sessions and lost >= set(self.sessions):
            return lost, "no session is left"
        return lost, ""

    def _cause(self, task: Task, session: str) -> str:
        for product in task.node.reads:
            for above in self.above(task, product):
                if above.state in ("failed", "skipped"):
                    return f"{above} {above.state}"
        return f"session {session} was left out before"

    # --- inputs -----------------------------------------------------------------------------------------------------

    def inputs(self, task: Task) -> list[Input]:
        """What a ready task reads, product by product.

        Raises
        ------
        ScanloomError : a product that the task needs one of is not there.
        """
        return [self._input(task, product) for product in task.node.reads]

    def _input(self, task: Task, product: type[Product]) -> Input:
        writer = self.writers.get(product)
        axes = part_axes(product, writer) if writer is not None else ("session",)
        plain = set(axes) <= set(task.node.axes)
        parts = [p for p in self._agreeing(task, product, axes) if dict(p[0]).get("session") not in task.lost]
        if plain and len(parts) != 1:
            raise ScanloomError(
                f"{len(parts)} products {product.NAME} were made where one is needed",
                where=str(task),
                next_step=f"look at what {writer.name if writer else 'the session'} wrote",
            )
        return Input(product, plain, sorted(parts, key=lambda p: p[0]))

    def _agreeing(
        self, task: Task, product: type[Product], axes: Sequence[str]
    ) -> list[tuple[Coordinate, Ref]]:
        shared = tuple(axis for axis in axes if axis in task.node.axes)
        place = _project(task.coordinate, shared)
        if task.session is None and shared:
            index = self._indexed(task, product, shared)
            return index.get(place, [])
        return [p for p in self._all(task, product) if _project(p[0], shared) == place]

    def _indexed(
        self, task: Task, product: type[Product], shared: tuple[str, ...]
    ) -> dict[Coordinate, list[tuple[Coordinate, Ref]]]:
        """Parts by the axes they share with tasks such as `task`; made once, when all of them are there."""
        index = self._indexes.get((product, shared))
        if index is None:
            index = defaultdict(list)
            for part in self._all(task, product):
                index[_project(part[0], shared)].append(part)
            whole = all(
                g.settled for w, s in self.providers(task, product) if w for g in self._groups_of(w, s)
            )
            if whole:
                self._indexes[product, shared] = index
        return index

    def _all(self, task: Task, product: type[Product]) -> list[tuple[Coordinate, Ref]]:
        found: list[tuple[Coordinate, Ref]] = []
        for writer, session in self.providers(task, product):
            if writer is None and session is not None:
                found.append(((("session", session),), Source(self.sessions[session], product)))
        found.extend(_parts(product, self.above(task, product)))
        return found


def _scopes(node: Node, sessions: Iterable[SessionInput]) -> list[str | None]:
    """Sessions a node runs for; one None for a node without session axis."""
    if "session" not in node.axes:
        return [None]
    return [session.name for session in sessions if node.only is None or node.only in session.tags]


def _parts(product: type[Product], tasks: Iterable[Task]) -> Iterator[tuple[Coordinate, Ref]]:
    for task in tasks:
        if task.artifact is not None:
            for part in task.artifact.of(product):
                yield part_coordinate(product, task.coordinate, part.key), (task, task.artifact, part)


def _losses(tasks: Iterable[Task]) -> frozenset[str]:
    lost: set[str] = set()
    for task in tasks:
        lost |= task.lost
        if task.state in ("failed", "skipped") and task.session is not None:
            lost.add(task.session)
    return frozenset(lost)


def _project(coordinate: Coordinate, axes: Sequence[str]) -> Coordinate:
    values = dict(coordinate)
    return tuple((axis, values[axis]) for axis in axes if axis in values)
