"""Runs the toy workflow in child processes that die at a chosen step, again and again, until one comes through.

A program of its own: `python -m tests.faults.crashing FOLDER SEED` prints how many children died.
"""

from __future__ import annotations

import os
import random
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from tests.pipeline.toys.workflow import log, request

STEPS = ("fsync", "rename", "mkdir", "replace", "rmdir", "unlink")
"""Calls around which a writer may die."""


def main(folder: Path, seed: int) -> int:
    """Number of children that were killed before one finished."""
    rng = random.Random(seed)
    for died in range(200):
        steps = rng.randint(1, 60)
        child = os.fork()
        if child == 0:
            _die_after(steps)
            result = run(asked(folder), Store(folder / "store"), cluster="none")
            os._exit(1 if result.failures else 0)
        _, status = os.waitpid(child, 0)
        if status == 0:
            return died
        if os.WTERMSIG(status) != signal.SIGKILL:
            raise SystemExit(f"child ended with {status}")
    raise SystemExit("no child came through")


def asked(folder: Path) -> Any:
    return request(log_once(folder, "a", range(30)), log_once(folder, "b", range(10, 35)))


def log_once(folder: Path, name: str, values: range) -> Any:
    return log(folder / "logs", name, values)


def _die_after(steps: int) -> None:
    """Kill this process at its n-th step, before or after the step is done."""
    left = [steps]

    def wrapped(call: Callable[..., Any]) -> Callable[..., Any]:
        def step(*args: Any, **kwargs: Any) -> Any:
            left[0] -= 1
            if left[0] == 0 and steps % 2:
                os.kill(os.getpid(), signal.SIGKILL)
            try:
                return call(*args, **kwargs)
            finally:
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        return step

    for name in STEPS:
        setattr(os, name, wrapped(getattr(os, name)))


if __name__ == "__main__":
    sys.stdout.write(str(main(Path(sys.argv[1]), int(sys.argv[2]))))
