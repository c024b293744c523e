"""The artifact store: folders named after the key of the task that made them, published whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import socket
import uuid
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from scanloom.pipeline.fingerprint import FileHashes, file_digest, files_digest
from scanloom.schemas.errors import ProductError, StoreError
from scanloom.schemas.product import Coordinate, Files, Product

if TYPE_CHECKING:
    from scanloom.pipeline.inspection import Explanation, Status
    from scanloom.pipeline.upkeep import Garbage, Problem

MANIFEST = "manifest.json"
RUN = "run.json"
TMP, RUNS, FAILURES, QUARANTINE = "tmp", "runs", "failures", "quarantine"
RESERVED = frozenset({TMP, RUNS, FAILURES, QUARANTINE})
HASHES = "hashes.sqlite"

_PART_KEY = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class StoredFile:
    """A file of a part; `path` is relative to the artifact."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class StoredPart:
    """One product, or one part of a split product, inside an artifact."""

    product: str
    key: str | None
    path: str
    """File, or folder for `Files`, relative to the artifact."""
    rows: int
    files: tuple[StoredFile, ...]
    digest: str

    @property
    def size(self) -> int:
        """Bytes of all its files."""
        return sum(file.size for file in self.files)

    @classmethod
    def from_json(cls, body: Mapping[str, Any]) -> Self:
        files = tuple(StoredFile(**file) for file in body["files"])
        return cls(body["product"], body["key"], body["path"], body["rows"], files, body["digest"])

    def to_json(self) -> dict[str, Any]:
        return {
            "product": self.product,
            "key": self.key,
            "path": self.path,
            "rows": self.rows,
            "files": [{"path": f.path, "size": f.size, "sha256": f.sha256} for f in self.files],
            "digest": self.digest,
        }


@dataclass(frozen=True)
class Artifact:
    """What one task wrote."""

    folder: Path
    stage: str
    key: str
    identity: Mapping[str, Any]
    """What the key was made of."""
    parts: tuple[StoredPart, ...]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Raises OSError or ValueError when `folder` holds no manifest."""
        body = json.loads((folder / MANIFEST).read_bytes())
        try:
            parts = tuple(StoredPart.from_json(part) for part in body["outputs"])
            return cls(folder, body["stage"], body["key"], body["identity"], parts)
        except (KeyError, TypeError) as error:
            raise ValueError(f"{folder / MANIFEST} is damaged: {error!r}") from error

    @cached_property
    def run(self) -> dict[str, Any]:
        """Circumstances of its making: host, wall time, peak memory, coordinate. Empty when they were lost."""
        try:
            body: dict[str, Any] = json.loads((self.folder / RUN).read_bytes())
        except (OSError, ValueError):
            return {}
        return body

    @property
    def size(self) -> int:
        return sum(file.size for part in self.parts for file in part.files)

    def of(self, product: type[Product]) -> list[StoredPart]:
        return [part for part in self.parts if part.product == product.NAME]

    def path(self, part: StoredPart) -> Path:
        return self.folder / part.path


class Store:
    """A folder of artifacts, `root/<stage>/<key>`. Many processes may use it at once.

    Raises
    ------
    StoreError : the folder cannot be made or written.
    """

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root).absolute()
        try:
            for name in ("", TMP, RUNS, FAILURES):
                (self.root / name).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise store_error(error, self.root) from error
        self.hashes = FileHashes(self.root / HASHES)

    def folder(self, stage: str, key: str) -> Path:
        return self.root / stage / key

    def find(self, stage: str, key: str) -> Artifact | None:
        """The artifact with this key; None when it was not made, or files of it are missing or cut."""
        try:
            artifact = Artifact.read(self.folder(stage, key))
            whole = all(
                (artifact.folder / f.path).stat().st_size == f.size for p in artifact.parts for f in p.files
            )
        except (OSError, ValueError):
            return None
        return artifact if whole else None

    def stages(self) -> list[str]:
        return sorted(p.name for p in self.root.iterdir() if p.is_dir() and p.name not in RESERVED)

    def artifacts(self, stage: str | None = None) -> Iterator[Artifact]:
        """All artifacts, or those of one stage, in a stable order."""
        for name in self.stages() if stage is None else [stage]:
            folder = self.root / name
            for key in sorted(os.listdir(folder)) if folder.is_dir() else []:
                artifact = self.find(name, key)
                if artifact is not None:
                    yield artifact

    @contextmanager
    def draft(self, stage: str, key: str) -> Iterator[Draft]:
        """A folder to write an artifact into; it vanishes unless `publish` is called."""
        name = f"{uuid.uuid4().hex}.{os.getpid()}.{socket.gethostname()}"
        folder = self.root / TMP / name
        with _writing(folder):
            folder.mkdir()
        try:
            with Draft(self, folder, stage, key) as draft:
                yield draft
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def verify(self) -> list[Problem]:
        """Hash every file again; damaged artifacts go to quarantine. See `upkeep.verify`."""
        from scanloom.pipeline import upkeep

        return upkeep.verify(self)

    def gc(self, **options: Any) -> Garbage:
        """Drop what recent runs did not use. See `upkeep.gc` for the options."""
        from scanloom.pipeline import upkeep

        return upkeep.gc(self, **options)

    def status(self) -> Status:
        """Size per stage, last runs, standing failures."""
        from scanloom.pipeline import inspection

        return inspection.status(self)


def explain(store: Store, key_or_prefix: str) -> Explanation:
    """Why an artifact is what it is. See `inspection.explain`."""
    from scanloom.pipeline import inspection

    return inspection.explain(store, key_or_prefix)


class Draft:
    """An artifact being written. Its methods raise `StoreError` when the disk is full or cannot be written."""

    def __init__(self, store: Store, folder: Path, stage: str, key: str) -> None:
        self.folder = folder
        self._store = store
        self._stage = stage
        self._key = key
        self._parts: dict[tuple[str, str | None], Future[StoredPart]] = {}
        self._sealer = ThreadPoolExecutor(1, "seal")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._sealer.shutdown(cancel_futures=True)

    @property
    def parts(self) -> list[StoredPart]:
        """What was written, once it is on the disk."""
        return [self._parts[name].result() for name in sorted(self._parts, key=lambda n: (n[0], n[1] or ""))]

    def write(self, product: Product, key: str | None) -> None:
        """Write one product, or one part of it. It is flushed to the disk and digested while the next is made."""
        name = (product.NAME, key)
        if name in self._parts:
            raise ProductError(f"{product.NAME} {key or ''} was written twice")
        if key is not None and not _PART_KEY.fullmatch(key):
            raise ProductError(f"part key {key!r} of {product.NAME} must be letters, digits, `.`, `_` or `-`")
        relative = product.NAME + product.SUFFIX if key is None else f"{product.NAME}/{key}{product.SUFFIX}"
        target = self.folder / relative
        with _writing(target):
            target.parent.mkdir(exist_ok=True)
            rows = product.write(target)
        self._parts[name] = self._sealer.submit(self._sealed, type(product), key, relative, rows)

    def _sealed(self, product: type[Product], key: str | None, relative: str, rows: int) -> StoredPart:
        target = self.folder / relative
        with _writing(target):
            files = tuple(self._seal(path) for path in _files_under(target))
        inner = {Path(f.path).relative_to(relative).as_posix(): f.sha256 for f in files}
        content = files_digest(inner) if issubclass(product, Files) else files[0].sha256
        return StoredPart(product.NAME, key, relative, rows, files, content)

    def publish(self, identity: Mapping[str, Any], run: Mapping[str, Any]) -> Artifact:
        """Make the artifact exist, at once and whole. When another writer was first, its artifact stands."""
        manifest = {
            "stage": self._stage,
            "key": self._key,
            "identity": identity,
            "outputs": [part.to_json() for part in self.parts],
        }
        target = self._store.folder(self._stage, self._key)
        with _writing(self.folder):
            _write_json(self.folder / RUN, run)
            _write_json(self.folder / MANIFEST, manifest)
            for folder in [p for p in self.folder.rglob("*") if p.is_dir()]:
                _sync_folder(folder)
            _sync_folder(self.folder)
            target.parent.mkdir(exist_ok=True)
            self._move(target)
            _sync_folder(target.parent)
            return Artifact.read(target)

    def _move(self, target: Path) -> None:
        try:
            os.rename(self.folder, target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
            if self._store.find(self._stage, self._key) is None:
                set_aside(self._store, target)
                os.rename(self.folder, target)

    def _seal(self, path: Path) -> StoredFile:
        with path.open("rb") as stream:
            os.fsync(stream.fileno())
        return StoredFile(path.relative_to(self.folder).as_posix(), path.stat().st_size, file_digest(path))


def set_aside(store: Store, folder: Path) -> Path:
    """Move a damaged artifact out of the way, for the curious."""
    quarantine = store.root / QUARANTINE
    quarantine.mkdir(exist_ok=True)
    target = quarantine / f"{folder.parent.name}-{folder.name[:16]}-{uuid.uuid4().hex[:8]}"
    os.rename(folder, target)
    return target


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise store_error(error, path) from error


def store_error(error: OSError, folder: Path) -> StoreError:
    """What a failed write means for the user."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        what = f"the disk is full ({error.strerror})"
        advice = "free some space (`scanloom gc` drops what recent runs did not use) and run the same command again"
    else:
        what = f"cannot write the store: {error.strerror or error}"
        advice = "check the folder and its permissions, or choose another with --store, and run the same command again"
    return StoreError(what, where=str(error.filename or folder), next_step=advice)


def open_part(product: type[Product], artifact: Artifact, part: StoredPart) -> Product:
    return product.open(artifact.path(part))


def part_coordinate(product: type[Product], task: Coordinate, key: str | None) -> Coordinate:
    """Where a part stands: at its task, plus the axis it is split along."""
    if key is None or product.SPLIT_BY is None:
        return task
    return (*task, (product.SPLIT_BY, key))


def _files_under(target: Path) -> list[Path]:
    return sorted(p for p in target.rglob("*") if p.is_file()) if target.is_dir() else [target]


def _write_json(path: Path, body: Mapping[str, Any]) -> None:
    with path.open("w", encoding="utf-8") as stream:
        json.dump(body, stream, indent=1, sort_keys=True, ensure_ascii=False)
        stream.write("\n")
        stream.flush()
        os.fsync(stream.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
