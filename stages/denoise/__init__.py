"""Denoise: a class for every point of every scan."""

from scanloom.stages.denoise.settings import Settings
from scanloom.stages.denoise.stage import VERSION, azimuth_step_rad, classify, denoise

__all__ = ["VERSION", "Settings", "azimuth_step_rad", "classify", "denoise"]
