"""What makes a task the same task: hashes of files, code and settings, and the key made of them."""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from scanloom.schemas.errors import InvalidInput, UsageError

SCHEMA = 1
"""Layout of keys and manifests; a new number makes every artifact anew."""

PACKAGE = "scanloom"
BLOCK = 1 << 20

LIBRARIES: dict[str, tuple[str, ...]] = {
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "numba": ("numba",),
    "pyarrow": ("pyarrow",),
    "gtsam": ("gtsam",),
    "small_gicp": ("small_gicp",),
    "open3d": ("open3d-cpu", "open3d"),
    "pyproj": ("pyproj",),
    "rosbags": ("rosbags",),
    "mcap": ("mcap",),
    "lz4": ("lz4",),
    "zstandard": ("zstandard",),
    "matplotlib": ("matplotlib",),
    "PIL": ("pillow",),
    "laspy": ("laspy",),
    "torch": ("torch",),
}
"""Libraries whose version may change a stage's bytes: import name, and the distributions that bring it."""


def canonical(value: Any) -> bytes:
    """The one JSON text of a value: sorted keys, no spaces, UTF-8."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def digest(value: Any) -> str:
    """SHA-256 of the canonical JSON of `value`, in hexadecimal."""
    return hashlib.sha256(canonical(value)).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb", buffering=0) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def files_digest(files: Mapping[str, str]) -> str:
    """Digest of a set of files from their relative names and digests; where they lie does not matter."""
    return digest(dict(files))


# --- code -----------------------------------------------------------------------------------------------------------


def code_version(stage: Callable[..., Any], version: int) -> dict[str, Any]:
    """The code a stage runs: `VERSION`, digests of its import closure, versions of its numeric libraries.

    The closure is found statically, by walking the import statements (also those inside functions) of the stage's
    module and of what it imports from the same package; packages count with their `__init__`.
    """
    modules, libraries = _closure(stage.__module__)
    return {
        "version": version,
        "modules": {name: _module_source(name)[1] for name in sorted(modules)},
        "libraries": {name: _library_version(name) for name in sorted(libraries)},
    }


def code_here(modules: Iterable[str]) -> dict[str, str]:
    """Digests of the named modules as this process finds them; absent modules have an empty digest."""
    return {name: _module_source(name)[1] if _is_module(name) else "" for name in modules}


@cache
def _closure(module: str) -> tuple[frozenset[str], frozenset[str]]:
    """Modules of ours, and libraries, that `module` needs."""
    roots = {PACKAGE, module.partition(".")[0]}
    found: set[str] = set()
    libraries: set[str] = set()
    pending = [module]
    while pending:
        name = pending.pop()
        if name in found:
            continue
        found.add(name)
        pending.extend(package for package in _parents(name) if _is_module(package))
        for imported in _imports(name):
            top = imported.partition(".")[0]
            if top in roots and _is_module(imported):
                pending.append(imported)
            elif top in LIBRARIES:
                libraries.add(top)
    return frozenset(found), frozenset(libraries)


def _parents(name: str) -> list[str]:
    pieces = name.split(".")
    return [".".join(pieces[:i]) for i in range(1, len(pieces))]


@cache
def _imports(module: str) -> frozenset[str]:
    """Absolute names that the module's import statements may load; `from a import b` gives `a` and `a.b`."""
    path, _ = _module_source(module)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names: set[str] = set()
    for statement in _statements(ast.parse(path.read_bytes(), filename=str(path))):
        if isinstance(statement, ast.Import):
            for alias in statement.names:
                names.update([*_parents(alias.name), alias.name])
        elif isinstance(statement, ast.ImportFrom):
            base = _absolute(statement, package)
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in statement.names)
    return frozenset(names)


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node, also nested ones; expressions hold no imports and are passed over."""
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        inner = getattr(node, block, ())
        for statement in inner if isinstance(inner, list) else ():
            yield statement
            yield from _statements(statement)


def _absolute(statement: ast.ImportFrom, package: str) -> str:
    if not statement.level:
        return statement.module or ""
    pieces = package.split(".")
    base = pieces[: len(pieces) - statement.level + 1]
    return ".".join([*base, *([statement.module] if statement.module else [])])


def _is_module(name: str) -> bool:
    return _file_of(name) is not None


@cache
def _file_of(name: str) -> Path | None:
    """Source file of a module, found without importing anything of its package (`find_spec` would import the parents)."""
    parent, _, leaf = name.rpartition(".")
    package = _file_of(parent) if parent else None
    if package is not None:
        inside = (package.parent / f"{leaf}.py", package.parent / leaf / "__init__.py")
        return next((path for path in inside if package.name == "__init__.py" and path.is_file()), None)
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, AttributeError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _module_source(name: str) -> tuple[Path, str]:
    """File of a module and the digest of its bytes, taken once per process, near its import."""
    path = _file_of(name)
    if path is None:
        raise UsageError(f"the source of module {name} cannot be found", next_step="declare stages in a file")
    return path, _source_digest(path)


def _source_digest(path: Path) -> str:
    """Digest of a module; a package's covers the templates beside it, which its modules read as they do code."""
    templates = sorted(path.parent.glob("*.html")) if path.name == "__init__.py" else []
    if not templates:
        return file_digest(path)[:16]
    return files_digest({file.name: file_digest(file) for file in (path, *templates)})[:16]


@cache
def _library_version(name: str) -> str:
    for distribution in LIBRARIES[name]:
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            continue
    return "absent"


# --- source files ---------------------------------------------------------------------------------------------------


Mark = tuple[str, int, int, int]
"""By which a file is known again: path, size, modification time in ns, inode."""


class FileHashes:
    """Digests of files outside the store, remembered by path, size, modification time and inode.

    The memory is a convenience: without it (read-only store, locked file) every file is hashed again.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def of(self, files: Mapping[str, Path]) -> dict[str, str]:
        """Digest of each named file.

        Raises
        ------
        InvalidInput : a file is missing or cannot be read.
        """
        try:
            marks = {name: _mark(path) for name, path in files.items()}
            known = self._recall(list(marks.values()))
            digests = {}
            fresh = {}
            for name, path in files.items():
                mark = marks[name]
                if mark not in known:
                    known[mark] = fresh[mark] = file_digest(path)
                digests[name] = known[mark]
        except OSError as error:
            raise InvalidInput(
                f"cannot be read: {error.strerror or error}",
                where=str(error.filename or ""),
                next_step="check that the file exists and that you may read it",
            ) from error
        self._remember(fresh)
        return digests

    def knows(self, paths: Iterable[Path]) -> bool:
        """Whether all these files were hashed before and are as they were."""
        try:
            marks = {_mark(path) for path in paths}
        except OSError:
            return False
        return marks <= self._recall(list(marks)).keys()

    def _recall(self, marks: list[Mark]) -> dict[Mark, str]:
        known = {}
        try:
            with _database(self._path) as database:
                for mark in marks:
                    row = database.execute(
                        "select sha256 from files where path=? and size=? and mtime_ns=? and inode=?", mark
                    ).fetchone()
                    if row:
                        known[mark] = row[0]
        except sqlite3.Error:
            pass
        return known

    def _remember(self, fresh: Mapping[Mark, str]) -> None:
        if not fresh:
            return
        try:
            with _database(self._path) as database:
                rows = [(*mark, sha256) for mark, sha256 in fresh.items()]
                database.executemany("insert or replace into files values (?, ?, ?, ?, ?)", rows)
        except sqlite3.Error:
            pass


def _mark(path: Path) -> Mark:
    found = path.stat()
    return str(path.resolve()), found.st_size, found.st_mtime_ns, found.st_ino


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that commits when all went well, and closes."""
    with closing(sqlite3.connect(path, timeout=5)) as connection:
        connection.execute(
            "create table if not exists files (path text primary key, size, mtime_ns, inode, sha256 text)"
        )
        yield connection
        connection.commit()
