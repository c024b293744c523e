"""Colour: what the images of a session say of the colour of the map's points."""

from scanloom.stages.colour.brightness import brightness
from scanloom.stages.colour.stage import VERSION, Settings, colour

__all__ = ["VERSION", "Settings", "brightness", "colour"]
