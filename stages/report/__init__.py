"""Report: what a map looks like, how far to trust it, and what went into it."""

from scanloom.stages.report.stage import report

__all__ = ["report"]
