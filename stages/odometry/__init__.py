"""Where the LiDAR was: every scan registered to a local map of the scans before it."""

from scanloom.stages.odometry.stage import VERSION, Settings, odometry

__all__ = ["VERSION", "Settings", "odometry"]
