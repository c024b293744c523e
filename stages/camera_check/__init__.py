"""Camera check: whether the cameras still stand where their calibration says."""

from scanloom.stages.camera_check.stage import VERSION, Settings, camera_check

__all__ = ["VERSION", "Settings", "camera_check"]
