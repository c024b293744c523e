"""The embedded sample session, written where the user wants it."""

from __future__ import annotations

from pathlib import Path

from scanloom.pipeline.plan import Request, SessionInput
from scanloom.pipeline.run import run
from scanloom.pipeline.store import Store
from scanloom.schemas.errors import UsageError
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.workflows.configuration import Overrides
from scanloom.workflows.delivery import place
from scanloom.workflows.map_session import NODES, SIMULATED
from scanloom.workflows.sessions import SAMPLE

TRUTH_FOLDER = "truth"


def write_sample(folder: Path, store: Path, settings: Overrides) -> list[str]:
    """Simulate (or take from the store) and write the log to `folder`, truth to `folder/truth`.

    Raises
    ------
    UsageError : the folder holds something else.
    """
    if folder.is_file() or (
        folder.is_dir() and any(folder.iterdir()) and not (folder / "metadata.yaml").exists()
    ):
        raise UsageError("is not an empty folder", where=str(folder), next_step="give a new folder")
    nodes = tuple(n for n in NODES if n.only == SIMULATED)
    session = SessionInput(name=SAMPLE, sources={}, tags=frozenset({SIMULATED}))
    result = run(Request(nodes=nodes, sessions=(session,), settings=settings), Store(store), cluster="none")
    for task in result.failures:
        if task.error is not None:
            raise task.error
    written = []
    for product, below in ((RawLog, ""), (TruthLog, TRUTH_FOLDER)):
        for _, root in result.files(product):
            for source in sorted(p for p in root.rglob("*") if p.is_file()):
                name = Path(below) / source.relative_to(root)
                place(source, folder / name)
                written.append(name.as_posix())
    return written
