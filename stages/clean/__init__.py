"""Clean: what the finished map says was seen through, and the final class of every point."""

from scanloom.stages.clean.rays import rays
from scanloom.stages.clean.relabel import relabel
from scanloom.stages.clean.stage import clean

__all__ = ["clean", "rays", "relabel"]
