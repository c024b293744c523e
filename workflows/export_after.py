"""Exports that follow a map: what fails there costs no map."""

from __future__ import annotations

from dataclasses import replace

from scanloom.pipeline.progress import Progress
from scanloom.schemas.errors import EXIT_OK, EXIT_SOME_FAILED, ScanloomError
from scanloom.workflows.build_map import Outcome
from scanloom.workflows.export_map import Exported, export_all, options_of


def export_after(
    outcome: Outcome, names: str, progress: Progress | None = None
) -> tuple[Outcome, list[Exported]]:
    """Export a map that was just made. What fails is added to the outcome's failures; the map itself is not touched."""
    try:
        done, failures = export_all(outcome.out, names, options_of(), progress=progress)
    except ScanloomError as error:
        done, failures = [], [(names, error)]
    rows = outcome.failures + [(f"export {name}", error) for name, error in failures]
    code = outcome.exit_code or (EXIT_SOME_FAILED if failures else EXIT_OK)
    return replace(outcome, failures=rows, exit_code=code), done
