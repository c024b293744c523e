"""Runs the toy workflow slowly, so that it can be killed from outside.

`python -m tests.faults.running FOLDER CLUSTER PAUSE_S`"""

from __future__ import annotations

import dataclasses
import signal
import sys
from pathlib import Path
from typing import Any

from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from tests.faults.crashing import asked


def slow(folder: Path, pause_s: float) -> Any:
    return dataclasses.replace(asked(folder), settings={"smooth": {"pause_s": pause_s}})


def main(folder: Path, cluster: str, pause_s: float) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
    request = slow(folder, pause_s)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    result = run(request, Store(folder / "store"), cluster=cluster, workers=2)
    sys.stdout.write(f"executed {result.executed}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
