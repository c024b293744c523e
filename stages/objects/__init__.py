"""Objects: tracks of what moves."""

from scanloom.stages.objects.settings import Settings
from scanloom.stages.objects.stage import VERSION, objects

__all__ = ["VERSION", "Settings", "objects"]
