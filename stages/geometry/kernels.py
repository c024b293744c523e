"""How numerics are compiled: numba without the GIL, with a cache that no stale code can poison.

Numba notices a change of the file that holds a kernel, but not of a file it calls into. The cache folder is
therefore named after the content of every module that holds kernels, and after where they lie: numba keeps what it compiled
by the paths of files. Other modules say `from ... import kernel`.

Numba itself is imported with the first call of a kernel: a command that only plans and waits never needs it.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., Any])


class Kernel:
    """A function that is compiled, or loaded from the cache, when it is first called; kernels may call each other."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        functools.update_wrapper(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return self.compiled(*arguments)

    @functools.cached_property
    def compiled(self) -> Any:
        """Numba's dispatcher: no GIL, no fast-math (same bytes on every machine of one kind), cached on disk."""
        options = {"cache": True, "nogil": True, "fastmath": False, "error_model": "numpy"}
        return _numba().njit(**options)(self.function)

    @property
    def name(self) -> str:
        return f"{self.function.__module__}:{self.function.__qualname__}"


_KERNELS: list[Kernel] = []


def kernel(function: F) -> F:
    """Compile a function, from its first call on."""
    _KERNELS.append(Kernel(function))
    return cast("F", _KERNELS[-1])


@functools.cache
def _numba() -> Any:
    """Numba with our cache folder; to its type inference a kernel is the dispatcher behind it."""
    import numba
    from numba.core import types
    from numba.extending import typeof_impl

    numba.config.CACHE_DIR = str(cache_folder())
    typeof_impl.register(Kernel)(lambda value, context: types.Dispatcher(value.compiled))
    return numba


@functools.cache
def cache_folder() -> Path:
    """`$SCANLOOM_CACHE`, else the user's cache folder, then a name that changes with the code and its place."""
    stages = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256(bytes(stages))
    for module in sorted(stages.rglob("*.py")):
        source = module.read_bytes()
        if b"kernels import kernel" in source or module == Path(__file__).resolve():
            digest.update(module.relative_to(stages).as_posix().encode() + b"\0" + source)
    base = os.environ.get("SCANLOOM_CACHE") or Path.home() / ".cache" / "scanloom"
    return Path(base) / f"kernels-{digest.hexdigest()[:16]}"


def _signatures_file() -> Path:
    return cache_folder() / "signatures.pickle"


def remember_signatures() -> None:
    """Note for which argument types each kernel was compiled so far, for `load_kernels` of other processes."""
    used = [each for each in _KERNELS if "compiled" in vars(each)]
    known = {each.name: each.compiled.signatures for each in used if each.compiled.signatures}
    cache_folder().mkdir(parents=True, exist_ok=True)
    part = _signatures_file().with_suffix(f".{os.getpid()}")
    part.write_bytes(pickle.dumps(known))
    part.replace(_signatures_file())


def load_kernels() -> Iterator[None]:
    """Load compiled kernels from the cache ahead of their first call, one a step; the first step sets numba up.

    Half a second for numba, five milliseconds for each kernel.
    """
    _numba()
    try:
        known = pickle.loads(_signatures_file().read_bytes())
    except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError):
        return
    for each in list(_KERNELS):
        for signature in known.get(each.name, ()):
            each.compiled.compile(signature)
            yield
