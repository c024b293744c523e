"""Images: what the cameras saw, and what is known of the cameras."""

from scanloom.stages.images.stage import VERSION, Settings, images

__all__ = ["VERSION", "Settings", "images"]
