"""Denoise: a class for every point of every scan."""

from scanloom.stages.denoise.settings import Settings
from scanloom.stages.denoise.stage import VERSION, classify, denoise

__all__ = ["VERSION", "Settings", "classify", "denoise"]
