"""How numerics are compiled: numba without the GIL, with a cache that no stale code can poison.

Numba notices a change of the file that holds a kernel, but not of a file it calls into. The cache folder is
therefore named after the content of every module that holds kernels. Other modules say `from ... import kernel`.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> Path:
    """`$SCANLOOM_CACHE`, else the user's cache folder, then a name that changes with the code."""
    stages = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for module in sorted(stages.rglob("*.py")):
        source = module.read_bytes()
        if b"kernels import kernel" in source or module == Path(__file__).resolve():
            digest.update(module.relative_to(stages).as_posix().encode() + b"\0" + source)
    base = os.environ.get("SCANLOOM_CACHE") or Path.home() / ".cache" / "scanloom"
    return Path(base) / f"kernels-{digest.hexdigest()[:16]}"


CACHE_FOLDER = _cache_folder()
numba.config.CACHE_DIR = str(CACHE_FOLDER)
SIGNATURES = CACHE_FOLDER / "signatures.pickle"

_KERNELS: list[Any] = []


def kernel(function: F) -> F:
    """Compile with numba: no GIL, no fast-math (same bytes on every machine of one kind), cached on disk."""
    compiled: F = numba.njit(cache=True, nogil=True, fastmath=False, error_model="numpy")(function)
    _KERNELS.append(compiled)
    return compiled


def remember_signatures() -> None:
    """Note for which argument types each kernel was compiled so far, for `load_kernels` of other processes."""
    known = {_name(k): k.signatures for k in _KERNELS if k.signatures}
    CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
    part = SIGNATURES.with_suffix(f".{os.getpid()}")
    part.write_bytes(pickle.dumps(known))
    part.replace(SIGNATURES)


def load_kernels() -> None:
    """Load compiled kernels from the cache ahead of their first call: together they take more than a second."""
    try:
        known = pickle.loads(SIGNATURES.read_bytes())
    except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError):
        return
    for each in list(_KERNELS):
        for signature in known.get(_name(each), ()):
            each.compile(signature)


def _name(dispatcher: Any) -> str:
    return f"{dispatcher.py_func.__module__}:{dispatcher.py_func.__qualname__}"
