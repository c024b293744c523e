"""The board in the cloud."""

from scanloom.stages.calibrate.cloud.background import static_points
from scanloom.stages.calibrate.cloud.found import CloudBoard, Refused, Search
from scanloom.stages.calibrate.cloud.search import find_boards, search_boards
from scanloom.stages.calibrate.cloud.settings import CloudSettings

__all__ = [
    "CloudBoard",
    "CloudSettings",
    "Refused",
    "Search",
    "find_boards",
    "search_boards",
    "static_points",
]
