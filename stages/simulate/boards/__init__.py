"""Calibration sessions: a rig of cameras and a LiDAR, a room, and a chessboard shown in several places."""

from scanloom.stages.simulate.boards.files import write_session
from scanloom.stages.simulate.boards.log import Timing, write_log
from scanloom.stages.simulate.boards.print import Print
from scanloom.stages.simulate.boards.session import BoardSession, Stand, board_session
from scanloom.stages.simulate.boards.settings import BoardSettings

__all__ = [
    "BoardSession",
    "BoardSettings",
    "Print",
    "Stand",
    "Timing",
    "board_session",
    "write_log",
    "write_session",
]
