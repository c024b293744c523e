"""Clouds of a board in a room: rays with a footprint, beams with errors of their own, somebody who holds the board."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.image import charuco_pattern
from scanloom.stages.geometry.se3 import inverse, pose, so3_exp

F8 = NDArray[np.float64]
BOARD = Board(inner_corners=(7, 5), square_m=0.095, board_m=(0.85, 0.61), offset_m=(0.002, 0.0))
FOOTPRINT = np.array([(0, 0), *[(0.55 * np.cos(a), 0.55 * np.sin(a)) for a in np.arange(6) * np.pi / 3],
                      *[(np.cos(a), np.sin(a)) for a in (np.arange(6) + 0.5) * np.pi / 3]])  # fmt: skip
FOOTPRINT_WEIGHT = np.exp(-2 * (FOOTPRINT**2).sum(axis=1))
MERGED_M = 0.4
"""Echoes nearer to each other than this are one."""


@dataclass(frozen=True)
class Lidar:
    """A spinning LiDAR; angles in degrees, lengths in metres."""

    beams: int = 16
    low_deg: float = -15.0
    high_deg: float = 15.0
    step_deg: float = 0.2
    sight_deg: tuple[float, float] = (-180.0, 180.0)
    range_sigma_m: float = 0.02
    beam_sigma_m: float = 0.01
    common_sigma_m: float = 0.01
    darker_m: float = 0.01
    width_m: float = 0.011
    divergence_rad: float = 0.003
    crossing_m: float = 0.0
    reflectance: float = 100.0
    """Of a white board; 0: the sensor has none."""


@dataclass(frozen=True)
class Panel:
    """A flat rectangle; z of its frame is its face."""

    T: F8
    size_m: tuple[float, float]
    albedo: float = 0.4
    board: Board | None = None


@dataclass(frozen=True)
class Ball:
    """An ellipsoid along the axes of the world."""

    centre: F8
    half_m: F8
    albedo: float = 0.35


@dataclass(frozen=True)
class Scene:
    boards: list[Panel] = field(default_factory=list)
    things: list[Panel | Ball] = field(default_factory=list)


def board_panel(T_lidar_board: F8, board: Board = BOARD) -> Panel:
    return Panel(T_lidar_board @ pose(np.eye(3), [*board.offset_m, 0.0]), board.board_m, 0.85, board)


def facing(
    distance: float, azimuth: float, height: float, spin: float, tilt: tuple[float, float] = (0.0, 0.0)
) -> F8:
    """T_lidar_board of a board that looks at the sensor; spin about its normal and tilts in degrees.

    With no spin x is horizontal.
    """
    a = np.radians(azimuth)
    centre = np.array([distance * np.cos(a), distance * np.sin(a), height])
    z = np.array([-np.cos(a), -np.sin(a), 0.0])
    y = np.array([0.0, 0.0, 1.0])
    R = np.column_stack((np.cross(y, z), y, z))
    turn = so3_exp([np.radians(tilt[0]), np.radians(tilt[1]), 0.0]) @ so3_exp([0.0, 0.0, np.radians(spin)])
    return pose(R @ turn, centre)


def room(holder: F8 | None = None, rng: np.random.Generator | None = None) -> list[Panel | Ball]:
    """Walls, floor, a table with a box, a pillar; and somebody behind the board at `holder` (4, 4), hands on its sides."""
    things: list[Panel | Ball] = []
    for a, d, w in ((0.0, 7.0, 12.0), (90.0, 4.5, 16.0), (180.0, 6.0, 12.0), (-90.0, 5.0, 16.0)):
        things.append(Panel(facing(d, a, 0.8, 0.0), (w, 4.2), 0.6))
    things.append(Panel(pose(np.eye(3), [0, 0, -1.3]), (14.0, 12.0), 0.3))
    things.append(Panel(pose(np.eye(3), [2.0, 2.9, -0.5]), (1.6, 0.8), 0.5))
    things.append(Panel(facing(3.3, 50.0, -0.25, 0.0), (0.5, 0.45), 0.7))
    things.append(Panel(facing(3.8, -60.0, 0.2, 0.0), (0.4, 3.0), 0.7))
    if holder is not None and rng is not None:
        c = holder[:3, 3]
        back = np.array([c[0], c[1], 0.0]) / np.hypot(c[0], c[1])
        things.append(Ball(c + 0.4 * back + [0, 0, -0.1], np.array([0.2, 0.24, 0.45])))
        things.append(Ball(c + 0.4 * back + [0, 0, 0.5], np.array([0.1, 0.09, 0.14])))
        for side in (-1, 1):
            reach = BOARD.board_m[1] / 2 + 0.02
            at = holder @ [rng.uniform(-0.2, 0.2), side * reach, -0.02, 1.0]
            things.append(Ball(at[:3], np.array([0.05, 0.05, 0.05]), 0.45))
            elbow = at[:3] + 0.22 * back + [0, 0, -0.15]
            things.append(Ball(elbow, np.array([0.06, 0.06, 0.18]), 0.35))
    return things


def scan(lidar: Lidar, scene: Scene, rng: np.random.Generator) -> tuple[F8, F8, NDArray[np.int64]]:
    """Points (n, 3), reflectance (n,) and rings (n,) of one turn."""
    elevation = np.radians(np.linspace(lidar.low_deg, lidar.high_deg, lidar.beams))
    azimuth = np.radians(np.arange(*lidar.sight_deg, lidar.step_deg) + rng.uniform(0, lidar.step_deg))
    ring, column = (
        v.ravel() for v in np.meshgrid(np.arange(lidar.beams), np.arange(len(azimuth)), indexing="ij")
    )
    jitter = np.radians(lidar.step_deg) * rng.uniform(-0.5, 0.5, lidar.beams)
    a, e = azimuth[column] + jitter[ring], elevation[ring]
    u = np.column_stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    left = np.column_stack((-np.sin(a), np.cos(a), np.zeros_like(a)))
    up = np.cross(u, left)
    start = np.column_stack((np.zeros_like(a), np.zeros_like(a), -lidar.crossing_m * np.tan(e)))
    ranges, energy = [], []
    for x, y in FOOTPRINT:
        offset = start + lidar.width_m / 2 * (x * left + y * up)
        direction = u + lidar.divergence_rad / 2 * (x * left + y * up)
        r, light = _cast(scene, offset, direction / np.linalg.norm(direction, axis=1)[:, None])
        ranges.append(r)
        energy.append(light)
    r, light = np.array(ranges), np.array(energy) * FOOTPRINT_WEIGHT[:, None]
    together = np.abs(r[:, None] - r[None]) < MERGED_M
    strength = (together * light[None]).sum(axis=1)
    best = np.argmax(strength, axis=0)
    mine = together[best, :, np.arange(len(a))].T * light
    total = mine.sum(axis=0)
    seen = (total > 0.004) & (rng.random(len(a)) > 0.005)
    distance = (mine * np.where(np.isfinite(r), r, 0)).sum(axis=0) / np.maximum(total, 1e-12)
    share = total / FOOTPRINT_WEIGHT.sum()
    off = rng.normal(0, lidar.common_sigma_m) + rng.normal(0, lidar.beam_sigma_m, lidar.beams)[ring]
    off = off + lidar.darker_m * np.clip(1 - share / 0.8, 0, 1) + rng.normal(0, lidar.range_sigma_m, len(a))
    distance = np.round((distance + off) / 0.002) * 0.002
    gain = rng.uniform(0.6, 1.3, lidar.beams)[ring] * (1 + 0.08 * rng.normal(size=len(a)))
    intensity = np.round(np.clip(lidar.reflectance * gain * share / 0.85, 0, 2.55 * lidar.reflectance), 2)
    return (u * distance[:, None])[seen], intensity[seen], ring[seen].astype(np.int64)


def _cast(scene: Scene, start: F8, direction: F8) -> tuple[F8, F8]:
    """Range and energy (n,) of thin rays; infinite and nothing where there is none."""
    best = np.full(len(direction), np.inf)
    light = np.zeros(len(direction))
    for thing in (*scene.boards, *scene.things):
        r, cosine, albedo = (
            _panel(thing, start, direction) if isinstance(thing, Panel) else _ball(thing, start, direction)
        )
        nearer = r < best
        best[nearer] = r[nearer]
        light[nearer] = (albedo * np.minimum(cosine + 0.15, 1.0))[nearer]
    return best, light


def _panel(panel: Panel, start: F8, direction: F8) -> tuple[F8, F8, F8]:
    to = inverse(panel.T)
    o, d = start @ to[:3, :3].T + to[:3, 3], direction @ to[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        r = -o[:, 2] / d[:, 2]
        x = o[:, :2] + r[:, None] * d[:, :2]
        hit = (r > 0.3) & (np.abs(x) <= np.asarray(panel.size_m) / 2).all(axis=1)
    albedo = np.full(len(r), panel.albedo)
    if panel.board is not None:
        square = np.floor(
            np.where(hit[:, None], x + panel.board.offset_m, 0) / panel.board.square_m
            + np.asarray(panel.board.squares) / 2
        )
        printed = ((square >= 0) & (square < panel.board.squares)).all(axis=1)
        if panel.board.charuco is None:
            albedo[printed & (square.sum(axis=1) % 2 == 0)] = 0.04
        else:
            albedo[printed] = np.where(
                _marked(panel.board, x[printed] + panel.board.offset_m), 0.04, albedo[printed]
            )
    return np.where(hit, r, np.inf), np.abs(d[:, 2]), albedo


def _marked(board: Board, xy: F8) -> NDArray[np.bool_]:
    """Whether places (n, 2) of a pattern with markers are dark."""
    size = tuple(_PX_A_SQUARE * squares for squares in board.squares)
    image = charuco_pattern(board, board.charuco).generateImage(size)
    column, row = (
        np.clip(
            (side * xy[:, k] / board.square_m + board.squares[k] / 2) * _PX_A_SQUARE, 0, size[k] - 1
        ).astype(int)
        for k, side in ((0, 1), (1, -1))
    )
    return np.asarray(image[row, column] < 128)


_PX_A_SQUARE = 40


def _ball(ball: Ball, start: F8, direction: F8) -> tuple[F8, F8, F8]:
    o, d = (start - ball.centre) / ball.half_m, direction / ball.half_m
    a, b, c = (d * d).sum(axis=1), (o * d).sum(axis=1), (o * o).sum(axis=1) - 1
    root = b * b - a * c
    r = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    r = np.where(r > 0.2, r, np.inf)
    return r, np.full(len(r), 0.7), np.full(len(r), ball.albedo)
