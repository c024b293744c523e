"""Fusion of odometry, loops, GNSS and gravity into poses."""

from scanloom.stages.fusion.poses import VERSION, Settings, fusion

__all__ = ["VERSION", "Settings", "fusion"]
