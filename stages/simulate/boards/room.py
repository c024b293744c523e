"""The room: walls, floor, lamps, pillars, cases, plates that are no board; and who or what holds the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8, transform
from scanloom.stages.simulate.boards.print import BLACK, THICK_M, WHITE, Print
from scanloom.stages.simulate.meshes import Material, Mesh, ball, box, cylinder, joined, quad

FLOOR_M, CEILING_M = -1.2, 1.9
_BEHIND_M = 0.45
"""So far behind its middle no tilted board reaches a pole."""
_LOOSE = Material.METAL
"""Colours are those of the parts; the meshes' materials mean nothing here."""


class Look(IntEnum):
    """How a surface's colour varies."""

    PLAIN = 0
    STAINED = 1
    TILED = 2
    PRINTED = 3
    SHINING = 4
    CHECKED = 5


@dataclass(frozen=True)
class Part:
    """Something of one colour (red, green, blue: share of light that comes back)."""

    mesh: Mesh
    colour: tuple[float, float, float]
    look: Look = Look.PLAIN


@dataclass(frozen=True)
class Scenery:
    """All triangles, with colour (m, 3) and look (m,) of each."""

    mesh: Mesh
    colour: F8
    look: NDArray[np.uint8]

    @classmethod
    def of(cls, parts: Sequence[Part]) -> Scenery:
        sizes = [len(part.mesh.triangles) for part in parts]
        colour = np.repeat(np.array([part.colour for part in parts], float), sizes, axis=0)
        return cls(
            joined([part.mesh for part in parts]),
            colour,
            np.repeat([part.look for part in parts], sizes).astype(np.uint8),
        )

    def reflectance(self, triangle: NDArray[np.int64], points: F8, T_board_lidar: F8, board: Print) -> F8:
        """Colour (n, 3) at points (n, 3) of the LiDAR's frame, before any light falls on it."""
        colour = self.colour[triangle].copy()
        look = self.look[triangle]
        rows = np.flatnonzero(look == Look.STAINED)
        x, y, z = points[rows].T
        colour[rows] *= (0.92 + 0.08 * _waves(x + 0.7 * y, z))[:, None]
        rows = np.flatnonzero(look == Look.TILED)
        x, y, z = points[rows].T
        joint = (np.mod(x, 0.6) < 0.008) | (np.mod(y, 0.6) < 0.008)
        colour[rows] *= np.where(joint, 0.6, 0.9 + 0.1 * _waves(x, y))[:, None]
        rows = np.flatnonzero(look == Look.CHECKED)
        x, y, z = points[rows].T
        cells = (np.floor(7 * (x + y)) + np.floor(9 * z)).astype(int) % 3
        colour[rows] *= (0.3 + 0.35 * cells)[:, None]
        printed = look == Look.PRINTED
        at = transform(T_board_lidar, points[printed])
        colour[printed] = np.where(board.dark(at[:, 0], at[:, 1]), BLACK, WHITE)[:, None]
        return colour


def _waves(u: F8, v: F8) -> F8:
    """Something cloudy between -1 and 1."""
    return np.asarray(np.sin(2.1 * u + 1.7 * np.sin(1.3 * v)) * np.sin(2.7 * v + 1.1 * np.sin(1.9 * u)))


def room(rng: np.random.Generator) -> tuple[list[Part], F8]:
    """What stands in the room, and its lamps (k, 3), in the LiDAR's frame."""
    front, back, side = rng.uniform(6.5, 9.0), -rng.uniform(3.0, 5.0), rng.uniform(4.8, 6.5)
    low, high = np.array([back, -side, FLOOR_M]), np.array([front, side, CEILING_M])
    parts = _shell(rng, low, high)
    lamps = np.array(
        [(x, y, CEILING_M - 0.05) for x in (back / 2, front / 3, front - 1.5) for y in (-side / 2, side / 2)]
    )
    half = np.array([0.6, 0.15, 0.02])
    parts += [Part(box(p - half, p + half, _LOOSE), (1.0, 1.0, 0.95), Look.SHINING) for p in lamps]
    parts += _furniture(rng, low, high)
    return parts, lamps  # fmt: skip


def _shell(rng: np.random.Generator, low: F8, high: F8) -> list[Part]:
    (a, b, c), (d, e, f) = low.tolist(), high.tolist()
    wall = tuple((rng.uniform(0.35, 0.7) * rng.uniform(0.85, 1.0, 3)).tolist())
    corners = [(a, b), (d, b), (d, e), (a, e)]
    parts = [
        Part(quad((*p, c), (*q, c), (*q, f), (*p, f), _LOOSE), wall, Look.STAINED)
        for p, q in zip(corners, [*corners[1:], corners[0]])
    ]
    floor = quad((a, b, c), (d, b, c), (d, e, c), (a, e, c), _LOOSE)
    ceiling = quad((a, b, f), (d, b, f), (d, e, f), (a, e, f), _LOOSE)
    return [*parts, Part(floor, (0.3, 0.28, 0.25), Look.TILED), Part(ceiling, (0.6, 0.6, 0.6))]


def _furniture(rng: np.random.Generator, low: F8, high: F8) -> list[Part]:
    """By the walls: cases, pillars, a door, a white plate and a poster of about the board's size."""
    parts = []
    for k in range(8):
        x = rng.uniform(low[0] + 0.6, high[0] - 0.6)
        wide, deep, tall = rng.uniform(0.3, 1.0), rng.uniform(0.3, 0.6), rng.uniform(0.5, 2.0)
        y = low[1] + deep / 2 if k % 2 else high[1] - deep / 2
        mesh = box(
            [x - wide / 2, y - deep / 2, FLOOR_M], [x + wide / 2, y + deep / 2, FLOOR_M + tall], _LOOSE
        )
        parts.append(Part(mesh, _colour(rng), Look.CHECKED if k % 4 == 0 else Look.PLAIN))
    for y in rng.uniform(low[1] + 1, high[1] - 1, 3):
        x = high[0] - rng.uniform(0.3, 1.2)
        parts.append(Part(cylinder([x, y, FLOOR_M], [x, y, CEILING_M], 0.15, _LOOSE, 12), _colour(rng)))
    y, z = rng.uniform(low[1] + 1.5, high[1] - 1.5), rng.uniform(-0.3, 0.4)
    plate = box([high[0] - 0.03, y - 0.45, z - 0.3], [high[0], y + 0.45, z + 0.3], _LOOSE)
    parts.append(Part(plate, (0.85, 0.85, 0.85)))
    poster = box([high[0] - 1.5, low[1], -0.4], [high[0] - 0.7, low[1] + 0.01, 0.5], _LOOSE)
    return [*parts, Part(poster, _colour(rng), Look.CHECKED)]  # fmt: skip


def _colour(rng: np.random.Generator) -> tuple[float, float, float]:
    r, g, b = (rng.uniform(0.05, 0.75) * rng.uniform(0.4, 1.0, 3)).tolist()
    return r, g, b


def board_parts(board: Print, T_lidar_board: F8, rng: np.random.Generator) -> list[Part]:
    """The plate with its print, and what holds it: a tripod or a person behind it."""
    plate = board.outline_m()
    print_ = quad(plate[0], plate[1], plate[2], plate[3], _LOOSE)
    low, high = plate[0] - (0, 0, THICK_M), plate[2] - (0, 0, 1e-4)
    body = box(low, high, _LOOSE)
    return [
        Part(_set(print_, T_lidar_board), (0.8, 0.8, 0.8), Look.PRINTED),
        Part(_set(body, T_lidar_board), (0.5, 0.5, 0.5)),
        *_holder(T_lidar_board, float(np.linalg.norm(board.board_m)) / 2, rng),
    ]


def _holder(T_lidar_board: F8, reach_m: float, rng: np.random.Generator) -> list[Part]:
    """Behind the board: a tripod whose head is screwed to it, or somebody who holds it with both hands."""
    middle, back = T_lidar_board[:3, 3], -T_lidar_board[:3, 2]
    flat = np.append(back[:2] / max(float(np.linalg.norm(back[:2])), 0.2), 0.0)
    if rng.random() < 0.5:
        crank = middle + 0.08 * back
        head = middle + _BEHIND_M * flat
        legs = [head + np.append(0.45 * np.array([np.cos(a), np.sin(a)]), 0.0) for a in (0.3, 2.4, 4.5)]
        feet = [np.array([leg[0], leg[1], FLOOR_M]) for leg in legs]
        joint = np.array([head[0], head[1], (head[2] + FLOOR_M) / 2])
        tubes = [
            cylinder(joint, head, 0.02, _LOOSE),
            *(cylinder(foot, joint, 0.015, _LOOSE) for foot in feet),
        ]
        tubes.append(cylinder(head, crank, 0.02, _LOOSE))
        tubes.append(cylinder(crank, middle + (THICK_M + 0.001) * back, 0.03, _LOOSE))
        return [Part(joined(tubes), (0.05, 0.05, 0.05))]
    body = middle + (_BEHIND_M + 0.2) * flat
    foot = np.array([body[0], body[1], FLOOR_M])
    parts = [Part(cylinder(foot, _above(foot, 0.85), 0.15, _LOOSE), (0.08, 0.1, 0.2))]
    parts.append(Part(cylinder(_above(foot, 0.8), _above(foot, 1.45), 0.21, _LOOSE, 10), _colour(rng)))
    parts.append(Part(ball(_above(foot, 1.62), (0.1, 0.1, 0.14), _LOOSE), (0.6, 0.42, 0.33)))
    shoulder = _above(foot, 1.35)
    across = T_lidar_board[:3, 0] * np.sign(T_lidar_board[1, 0] or 1.0)
    for sign in (-1.0, 1.0):
        hand = middle + 0.5 * sign * reach_m * across + 0.04 * back
        parts.append(Part(cylinder(shoulder, hand, 0.045, _LOOSE), (0.6, 0.42, 0.33)))
    return parts


def _above(point: F8, height_m: float) -> F8:
    return np.array([point[0], point[1], point[2] + height_m])


def _set(mesh: Mesh, T: F8) -> Mesh:
    return Mesh(transform(T, mesh.vertices), mesh.triangles, mesh.material)
