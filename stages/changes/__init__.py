"""Changes: what of an extended map the new sessions saw through."""

from scanloom.stages.changes.stage import changes

__all__ = ["changes"]
