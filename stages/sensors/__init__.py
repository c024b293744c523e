"""IMU and wheels held against the motion between scans: wrong clocks, units, axes and scales are found and corrected."""

from scanloom.stages.sensors.stage import VERSION, Settings, sensors

__all__ = ["VERSION", "Settings", "sensors"]
