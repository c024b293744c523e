"""What runs in a worker: open the inputs, call the stage, write and publish what it returns."""

from __future__ import annotations

import ctypes
import importlib
import os
import socket
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from scanloom.pipeline.fingerprint import code_here
from scanloom.pipeline.memory import PeakMemory
from scanloom.pipeline.overlap import read_ahead, write_behind
from scanloom.pipeline.store import Draft, Store
from scanloom.schemas.errors import ProductError, ScanloomError, StageError
from scanloom.schemas.product import Coordinate, Files, Part, Parts, Product, Stream

Json = dict[str, Any]


def import_path(thing: Any) -> str:
    """`module:name` of a function or class, by which a worker finds it."""
    return f"{thing.__module__}:{thing.__qualname__}"


def imported(path: str) -> Any:
    """The function or class at `module:name`."""
    module, _, name = path.partition(":")
    found: Any = importlib.import_module(module)
    for piece in name.split("."):
        found = getattr(found, piece)
    return found


LARGE_MB = 450.0
"""A worker that grew beyond this gives memory back after the task; below, keeping it saves the next task time."""


_under_way: set[str] = set()


def at_work() -> bool:
    """Whether this process carries out a task now."""
    return bool(_under_way)


def execute(spec: Json) -> Json:
    """Run one task; JSON in, JSON out. A failure is part of the answer, so that it survives the way back."""
    _under_way.add(spec["key"])
    try:
        return _answer(spec)
    finally:
        _under_way.discard(spec["key"])


def _answer(spec: Json) -> Json:
    limit_threads()
    started = time.perf_counter()
    with PeakMemory() as memory:
        try:
            _compute(spec, started, memory)
            error = None
        except Exception as problem:
            error = describe_error(problem, spec["place"])
    if memory.peak_mb > LARGE_MB:
        release_memory()
    return {
        "error": error,
        "wall_s": time.perf_counter() - started,
        "peak_rss_mb": memory.peak_mb,
        "pid": os.getpid(),
        "host": socket.gethostname(),
    }


def release_memory() -> None:
    """Give freed memory back to the system once a task is over, so that a worker does not grow with the number of tasks."""
    import pyarrow as pa

    pa.default_memory_pool().release_unused()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc
    if trim is not None:
        trim(0)


def limit_threads() -> None:
    """One native thread per worker: as many workers as cores already fill the machine."""
    import pyarrow as pa

    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


def describe_error(error: Exception, place: str) -> Json:
    """An error as JSON; what is not ours is named after the task."""
    trace = "".join(traceback.format_exception(error))
    if isinstance(error, ScanloomError):
        where = f"{place}: {error.where}" if error.where else place
        kind = import_path(type(error))
        return {
            "kind": kind,
            "what": error.what,
            "where": where,
            "next_step": error.next_step,
            "trace": trace,
        }
    cause = f"{type(error).__name__}: {error}".splitlines()[0]
    return {
        "kind": import_path(ScanloomError),
        "what": cause,
        "where": place,
        "next_step": "",
        "trace": trace,
    }


def rebuild_error(body: Json) -> ScanloomError:
    """The error that `describe_error` described."""
    try:
        kind = imported(body["kind"])
    except (ImportError, AttributeError):
        kind = ScanloomError
    arguments = {"where": body["where"], "next_step": body["next_step"]}
    try:
        error: ScanloomError = kind(body["what"], **arguments)
    except TypeError:
        error = ScanloomError(body["what"], **arguments)
    return error


def _compute(spec: Json, started: float, memory: PeakMemory) -> None:
    store = Store(spec["store"])
    stage = imported(spec["stage"])
    _check_code(spec["identity"]["code"]["modules"])
    settings = imported(spec["settings_model"]).model_validate(spec["identity"]["settings"])
    products = [_opened(entry, spec["overlap"]) for entry in spec["reads"]]
    with store.draft(spec["identity"]["stage"], spec["key"]) as draft:
        _write(draft, stage(settings, *products), spec)
        run = {
            **spec["circumstances"],
            "coordinate": spec["coordinate"],
            "finished_unix_s": time.time(),
            "host": socket.gethostname(),
            "wall_s": time.perf_counter() - started,
            "peak_rss_mb": memory.peak_mb,
        }
        draft.publish(spec["identity"], run)


def _check_code(modules: Mapping[str, str]) -> None:
    """The code here must be the code the key was made of."""
    here = code_here(modules)
    changed = sorted(name for name in modules if here[name] != modules[name])
    if changed:
        raise ScanloomError(
            f"the code changed while it ran, or this worker has another version: {', '.join(changed)}",
            next_step="run the same command again; on a cluster, install the same version everywhere",
        )


def _opened(entry: Json, overlap: bool) -> Any:
    """One argument of the stage: a product, or `Parts` that open theirs when asked."""
    product: type[Product] = imported(entry["product"])
    load = partial(_open, product, overlap)
    parts: list[tuple[Coordinate, Any]] = [
        (tuple((axis, value) for axis, value in part["coordinate"]), part) for part in entry["parts"]
    ]
    return load(parts[0][1]) if entry["plain"] else Parts(parts, load=load)


def _open(product: type[Product], overlap: bool, part: Json) -> Product:
    path = Path(part["path"])
    if "names" in part and issubclass(product, Files):
        return product(root=path, names=tuple(part["names"]))
    if overlap and issubclass(product, Stream):
        return product.open(path, read_ahead)
    return product.open(path)


def _write(draft: Draft, returned: Any, spec: Json) -> None:
    """Write what a stage returned, each product before the next is asked for."""
    declared = {product.NAME: product for product in map(imported, spec["writes"])}
    axes = [axis for axis, _ in spec["coordinate"]]
    for item in _items(returned):
        product, key = (item.product, item.key) if isinstance(item, Part) else (item, None)
        if not isinstance(product, Product) or declared.get(product.NAME) is not type(product):
            raise ProductError(
                f"the stage returned {type(product).__name__}, which its node does not declare"
            )
        split = product.SPLIT_BY is not None and product.SPLIT_BY not in axes
        if split != isinstance(item, Part):
            raise ProductError(f"{product.NAME} must {'' if split else 'not '}be returned as `Part`s")
        if spec["overlap"] and isinstance(product, Stream):
            write_behind(product, partial(draft.write, key=key))
        else:
            draft.write(product, key)
    written = {part.product for part in draft.parts}
    for name, product in declared.items():
        split = product.SPLIT_BY is not None and product.SPLIT_BY not in axes
        if name not in written and not split:
            raise StageError(f"the stage did not return {name}", next_step="this is a fault of the stage")


def _items(returned: Any) -> Iterator[Any]:
    if isinstance(returned, (Product, Part)):
        yield returned
    elif isinstance(returned, Iterable):
        yield from returned
    else:
        raise ProductError(f"the stage returned {type(returned).__name__}, not products")
