"""The identity of a task: what its key is made of, and the order by which a worker carries it out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanloom.pipeline.fingerprint import SCHEMA, code_version, digest, files_digest
from scanloom.pipeline.flow import Flow, Input, Source, Task
from scanloom.pipeline.node import ALONE, Node
from scanloom.pipeline.store import Store
from scanloom.pipeline.task import Json, import_path
from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.product import Coordinate, Files


@dataclass(frozen=True)
class Order:
    """A task ready to be looked up or carried out."""

    key: str
    identity: Json
    spec: Json
    inputs: list[Input]

    @property
    def input_bytes(self) -> int:
        """Size of what the task reads from the store."""
        refs = [ref for entry in self.inputs for _, ref in entry.parts]
        return sum(ref[2].size for ref in refs if not isinstance(ref, Source))


class Identifier:
    """Makes orders; remembers code versions and the digests of source files for one run."""

    def __init__(self, flow: Flow, store: Store) -> None:
        self._flow = flow
        self._store = store
        self._stamps: dict[tuple[Path, tuple[str, ...]], dict[str, tuple[int, int]]] = {}
        self._bytes: dict[str | None, int] = {}
        self._circumstances = {"git_commit": git_commit()}
        self._code: dict[str, Json] = {}
        self._sources: dict[tuple[Path, tuple[str, ...]], str] = {}

    def order(self, task: Task, inputs: list[Input]) -> Order:
        """The key of a task and how to compute it.

        Raises
        ------
        InvalidInput : a source file cannot be read.
        """
        known, reads = [], []
        for entry in inputs:
            parts = [self._part(coordinate, ref) for coordinate, ref in entry.parts]
            shown = [[None if entry.plain else dict(p["coordinate"]), p["digest"]] for p in parts]
            known.append({"product": entry.product.NAME, "parts": shown})
            reads.append({"product": import_path(entry.product), "plain": entry.plain, "parts": parts})
        identity = {**self.constant(task), "inputs": known}
        key = digest(identity)
        node = task.node
        spec = {
            "store": str(self._store.root),
            "key": key,
            "identity": identity,
            "stage": import_path(node.stage),
            "settings_model": import_path(node.settings),
            "coordinate": [list(pair) for pair in task.coordinate],
            "place": str(task),
            "circumstances": self._circumstances,
            "reads": reads,
            "writes": [import_path(product) for product in node.writes],
            "overlap": node.per in ALONE,
        }
        return Order(key, identity, spec, inputs)

    def constant(self, task: Task) -> Json:
        """The part of the identity that does not depend on inputs: stage, code, settings."""
        node = task.node
        shared = {} if node.settings_of == node.name else {"settings_of": node.settings_of}
        return {
            "schema": SCHEMA,
            "stage": node.name,
            "code": self._code_of(node),
            "settings": task.settings.model_dump(mode="json"),
            **shared,
        }

    def changed_sources(self, inputs: list[Input]) -> list[str]:
        """Files from outside that are no longer what the key was made of: somebody is still writing them."""
        changed: list[str] = []
        for entry in inputs:
            for _, ref in entry.parts:
                if isinstance(ref, Source):
                    files = ref.session.sources[ref.product]
                    root = _root(files)
                    now = {name: _stamp(root / name) for name in files.names}
                    before = self._stamps.get((root, files.names), now)
                    changed.extend(str(root / name) for name in files.names if now[name] != before[name])
        return changed

    def knows_sources(self) -> bool:
        """Whether the store has seen all logs before; if not, there is work to do."""
        sources = [files for session in self._flow.sessions.values() for files in session.sources.values()]
        if any(_homeless(files) for files in sources):
            return False
        return self._store.hashes.knows(path for files in sources for path in _paths(files))

    def session_bytes(self, task: Task) -> int:
        """Size of the files that the task's session brings along; 0 for tasks of the whole map."""
        session = task.session
        if session not in self._bytes:
            sources = self._flow.sessions[session].sources.values() if session is not None else ()
            self._bytes[session] = sum(_stamp(path)[0] for files in sources for path in _paths(files))
        return self._bytes[session]

    def foresee(self) -> None:
        """Find the code versions of all stages: a tenth of a second that passes while the first tasks run, not between tasks."""
        for node in self._flow.nodes:
            self._code_of(node)

    def _code_of(self, node: Node) -> Json:
        if node.name not in self._code:
            self._code[node.name] = code_version(node.stage, node.version)
        return self._code[node.name]

    def _part(self, coordinate: Coordinate, ref: Any) -> Json:
        place = [list(pair) for pair in coordinate]
        if isinstance(ref, Source):
            files = ref.session.sources[ref.product]
            root = _root(files)
            return {
                "coordinate": place, "path": str(root), "names": list(files.names), "digest": self._source(root, files),
            }  # fmt: skip
        _, artifact, part = ref
        return {"coordinate": place, "path": str(artifact.path(part)), "digest": part.digest}

    def _source(self, root: Path, files: Files) -> str:
        mark = (root, files.names)
        if mark not in self._sources:
            self._stamps[mark] = {name: _stamp(root / name) for name in files.names}
            paths: Mapping[str, Path] = {name: root / name for name in files.names}
            self._sources[mark] = files_digest(self._store.hashes.of(paths))
        return self._sources[mark]


def _homeless(files: Files) -> bool:
    """Whether nothing tells where the files lie. The tasks that read them fail; no other task does."""
    return files.root is None and bool(files.names)


def _paths(files: Files) -> list[Path]:
    """Where the files lie, as far as that is told."""
    return [] if _homeless(files) else [_root(files) / name for name in files.names]


def _root(files: Files) -> Path:
    if _homeless(files):
        raise InvalidInput("source files have no folder", next_step="give Files(root=..., names=...)")
    return Path(files.root or ".").absolute()


def _stamp(path: Path) -> tuple[int, int]:
    """Size and modification time, ns; (0, 0) when there is no such file."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def git_commit() -> str:
    """Commit of the checkout this code runs from; empty for an installed package."""
    git = Path(__file__).resolve().parents[1] / ".git"
    try:
        head = (git / "HEAD").read_text().strip()
        return (git / head[5:]).read_text().strip() if head.startswith("ref: ") else head
    except OSError:
        return ""
