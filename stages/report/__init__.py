"""Report: what a map looks like, how far to trust it, and what went into it."""

from scanloom.stages.report.map_picture import picture
from scanloom.stages.report.stage import report

__all__ = ["picture", "report"]
