"""The tunnel under its hill: walls, ceiling, portals, and what hangs on them."""

from __future__ import annotations

import numpy as np

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.meshes import Material, Mesh, box, grid_mesh, joined, quad
from scanloom.stages.simulate.terrain import Plan, height, relief, smoothstep

TUNNEL_HALF_M, TUNNEL_TALL_M, HILL_M = 5.0, 5.2, 8.0
BARE_M = 100.0
"""Up to this length a tunnel has lamps and nothing else."""
STATION_M, SIGN_M = 150.0, 25.0
"""Longest way between emergency stations, and between the signs that show the way out: EU directive 2004/54/EC, annex I."""
NICHE_WIDE_M, NICHE_DEEP_M, NICHE_TALL_M = 2.5, 1.0, 2.4
Span = tuple[float, float]


def tunnel(plan: Plan) -> list[tuple[Mesh, PointClass]]:
    """Two walls and a ceiling, the portals, the hill above; in a long one signs, and emergency stations in niches."""
    x = _along(*plan.tunnel, 4.0)
    floor = _floor(x)
    long = plan.tunnel_m > BARE_M
    parts = []
    for side in (-TUNNEL_HALF_M, TUNNEL_HALF_M):
        parts += _wall(plan, side, stations(plan, side) if long else [])
    edges = np.array([-TUNNEL_HALF_M, TUNNEL_HALF_M])
    parts.append(grid_mesh(x, edges, np.vstack((floor, floor)) + TUNNEL_TALL_M, Material.CONCRETE))
    for lamp in np.arange(plan.tunnel[0] + 9, plan.tunnel[1], 18.0):
        z = float(_floor(lamp)) + TUNNEL_TALL_M
        parts.append(box([lamp - 0.5, -0.2, z - 0.15], [lamp + 0.5, 0.2, z], Material.METAL))
    parts += _signs(plan) if long else []
    return [(joined([*parts, *_portals(plan)]), PointClass.STATIC), (_hill(plan), PointClass.GROUND)]


def stations(plan: Plan, side: float) -> list[Span]:
    """Where along x the niches of one wall begin and end, m: evenly spaced, on the right and the left in turn."""
    count = int(np.ceil(plan.tunnel_m / STATION_M)) - 1
    middles = plan.tunnel[0] + plan.tunnel_m * np.arange(1, count + 1) / (count + 1)
    return [
        (float(m) - NICHE_WIDE_M / 2, float(m) + NICHE_WIDE_M / 2) for m in middles[0 if side < 0 else 1 :: 2]
    ]


def _wall(plan: Plan, side: float, niches: list[Span]) -> list[Mesh]:
    """Wall along the tunnel, interrupted by niches."""
    ends = [plan.tunnel[0], *(edge for niche in niches for edge in niche), plan.tunnel[1]]
    parts = [_upright(a, b, side, -1.0, TUNNEL_TALL_M) for a, b in zip(ends[::2], ends[1::2])]
    for a, b in niches:
        back = side + float(np.sign(side)) * NICHE_DEEP_M
        parts += [_upright(a, b, side, NICHE_TALL_M, TUNNEL_TALL_M), _upright(a, b, back, -1.0, NICHE_TALL_M)]
        foot, top = float(_floor(a)) - 1.0, float(_floor(a)) + NICHE_TALL_M
        for x in (a, b):
            parts.append(
                quad([x, side, foot], [x, back, foot], [x, back, top], [x, side, top], Material.CONCRETE)
            )
        parts.append(quad([a, side, top], [b, side, top], [b, back, top], [a, back, top], Material.CONCRETE))
    return parts


def _upright(a: float, b: float, y: float, low_m: float, high_m: float) -> Mesh:
    """Surface along x from a to b, between two heights above the floor."""
    x = _along(a, b, 4.0)
    rise = np.array([low_m, high_m])
    flat = grid_mesh(x, rise, _floor(x)[None, :] + rise[:, None], Material.CONCRETE)
    turned = np.column_stack((flat.vertices[:, 0], np.full(len(flat.vertices), y), flat.vertices[:, 2]))
    return Mesh(turned, flat.triangles, flat.material)


def _signs(plan: Plan) -> list[Mesh]:
    """Signs that show the way out, on both walls."""
    out = []
    for x in np.arange(plan.tunnel[0] + SIGN_M / 2, plan.tunnel[1], SIGN_M):
        for side in (-TUNNEL_HALF_M, TUNNEL_HALF_M):
            y, z = sorted((side, side - 0.08 * np.sign(side))), float(_floor(x))
            out.append(box([x - 0.35, y[0], z + 1.1], [x + 0.35, y[1], z + 1.5], Material.RETRO))
    return out


def _along(a: float, b: float, step_m: float) -> F8:
    """From a to b in steps, the last one shorter."""
    return np.append(np.arange(a, b - 0.1, step_m), b)


def _floor(x: F8 | float) -> F8:
    """Height of the tunnel's floor, m."""
    at = np.asarray(x, float)
    return relief(at, np.zeros_like(at))


def _hilltop(plan: Plan, x: F8, y: F8) -> F8:
    return height(plan, x, y) + HILL_M * (1 - smoothstep((np.abs(y) - 8) / 27)) + 0.2


def _hill(plan: Plan) -> Mesh:
    x, y = _along(*plan.tunnel, 2.0), np.arange(-36.0, 36.1, 2.0)
    X, Y = np.meshgrid(x, y)
    return grid_mesh(x, y, _hilltop(plan, X, Y), Material.GRASS)


def _portals(plan: Plan) -> list[Mesh]:
    """Walls between the ground, or the ceiling over the road, and the top of the hill."""
    out = []
    y = np.concatenate((np.arange(-36, -5, 1.0), [-5.0, 5.0], np.arange(6, 36.1, 1.0)))
    for x in plan.tunnel:
        at = np.full(len(y), x)
        top, ground = _hilltop(plan, at, y), height(plan, at, y) - 1.0
        ceiling = float(_floor(x)) + TUNNEL_TALL_M
        for i in range(len(y) - 1):
            over_road = abs(y[i] + y[i + 1]) < 0.5
            low = (ceiling, ceiling) if over_road else (ground[i], ground[i + 1])
            vertices = np.array(
                [[x, y[i], low[0]], [x, y[i + 1], low[1]], [x, y[i + 1], top[i + 1]], [x, y[i], top[i]]]
            )
            out.append(
                Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, Material.CONCRETE, np.uint8))
            )
    return out
