"""What a search in a cloud gives."""

from __future__ import annotations

from dataclasses import dataclass

from scanloom.stages.calibrate.cloud.evidence import Evidence
from scanloom.stages.calibrate.cloud.sweep import B1, I8
from scanloom.stages.geometry.se3 import F8


@dataclass(frozen=True)
class CloudBoard:
    """A board found in a cloud; all in the LiDAR's frame."""

    points_m: F8
    """(k, 3) of the board, as measured."""
    source: I8
    """(k,) their numbers in the cloud."""
    edge_points_m: F8
    """(e, 3) where the board's outline crosses its plane between the last ray on it and the first beyond."""
    edge_directions: F8
    """(e, 3) unit vectors of the beam there."""
    edge_left: B1
    """(e,) left end of a beam on the board, as the sensor sees it; else the right end."""
    edge_line: I8
    """(e,) side of the outline: from vertex k to vertex k + 1 of `Board.outline_m`."""
    edge_sigma_m: F8
    """(e,) across the line."""
    T_lidar_board: F8
    covariance: F8
    """(6, 6) of the right tangent (rotation, translation), in the board's axes."""
    extent_m: tuple[float, float]
    """Measured size along the board's dimensions; NaN along one that no edge tells."""
    rmse_m: float
    """Of the ranges about the plane."""
    beam_sigma_m: float
    """Scatter between beams in it."""
    darker_m: float
    """By how much dark print reads farther than bright print."""
    flare_m: float
    """By how much the board looks larger on each side."""
    crossing_m: float
    """How far before the axis beams cross; weakly known from one board."""
    farther_m: float
    """How much too far all ranges read, by the size of squares and outline; weakly known from one board."""
    evidence: Evidence
    """All of it for a graph, with the errors of the sensor as unknowns."""
    corners_m: F8
    """(m*n, 3) virtual corners, ordered as `Board.corners_m`."""
    corner_covariance: F8
    """(m*n, 3, 3) of each of them, m^2."""
    first_dark: bool | None
    """The square at the lowest x and y is dark; None where squares were not seen."""
    contrast: float
    """Correlation of the reflectance with the print."""
    quality: float
    """0 to 1: how much of piece and board overlap, times the contrast."""


@dataclass(frozen=True)
class Refused:
    """A flat piece that is no board."""

    centre_m: F8
    points: int
    reason: str


@dataclass(frozen=True)
class Search:
    """What was found in a cloud, the best first, and what was refused, the largest first."""

    boards: tuple[CloudBoard, ...]
    refused: tuple[Refused, ...]
