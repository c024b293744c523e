"""The ground: height, roads, what it is made of.

Coordinates are metres east, north and up of the origin. A `Layout` says where roads run and how the land rises; `Plan` is
the town's: South Street runs along y = 0 into the tunnel and on to
the field; the bridge carries a street along x = BRIDGE_X over North Street (y = NORTH_Y). A longer tunnel moves what lies
east of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.meshes import Material, Mesh, grid_mesh

WEST, SOUTH, NORTH = -185.0, -110.0, 255.0
CELL_M = 1.25
RASTER_M = 0.25
BRIDGE_X, NORTH_Y, PLATEAU_Y, EAST_X = 45.0, 90.0, 150.0, 90.0
OPENING = (82.0, 98.0)
TUNNEL_X, TUNNEL_M = 125.0, 72.0
RISE_M, DIP_M = 4.2, 2.0
ROUNDABOUT = (-75.0, 0.0)
ROUNDABOUT_R = 9.0
LANE_M = 1.75


@dataclass(frozen=True)
class Road:
    """Straight from `a` to `b`, or an arc about `centre`; `town` roads have parking bays and sidewalks."""

    a: tuple[float, float]
    b: tuple[float, float]
    town: bool = True
    centre: tuple[float, float] | None = None

    def distance(self, x: F8, y: F8) -> F8:
        """Distance to the centre line, m; infinite beside the ends of an arc."""
        if self.centre is not None:
            return self._arc_distance(x, y, self.centre)
        dx, dy = self.b[0] - self.a[0], self.b[1] - self.a[1]
        along = ((x - self.a[0]) * dx + (y - self.a[1]) * dy) / (dx * dx + dy * dy)
        along = np.clip(along, 0, 1)
        off: F8 = np.hypot(x - self.a[0] - along * dx, y - self.a[1] - along * dy)
        return off

    def _arc_distance(self, x: F8, y: F8, centre: tuple[float, float]) -> F8:
        u, v = x - centre[0], y - centre[1]
        radius = np.hypot(self.a[0] - centre[0], self.a[1] - centre[1])
        off: F8 = np.abs(np.hypot(u, v) - radius)
        if self.a == self.b:
            return off
        start = np.arctan2(self.a[1] - centre[1], self.a[0] - centre[0])
        end = np.arctan2(self.b[1] - centre[1], self.b[0] - centre[0])
        inside = np.mod(np.arctan2(v, u) - start, 2 * np.pi) <= np.mod(end - start, 2 * np.pi)
        return np.where(inside, off, np.inf)


class Layout(Protocol):
    """What the ground is built from."""

    @property
    def east(self) -> float:
        """Eastern edge of the ground, m; the other edges are WEST, SOUTH and NORTH."""

    def roads(self) -> tuple[Road, ...]:
        """All roads."""

    def height(self, x: F8, y: F8) -> F8:
        """Height of the ground, m."""

    def on_deck(self, p: F8, d: F8) -> NDArray[np.bool_]:
        """Whether a vehicle at places p (n, 3), heading along d (n, 3), is on a bridge rather than on the ground."""


@dataclass(frozen=True)
class Plan:
    """Where the tunnel ends and what lies beyond it: x in metres, for a tunnel of a given length."""

    tunnel_m: float = TUNNEL_M

    @property
    def beyond_m(self) -> float:
        """How far everything beyond the tunnel is moved, m."""
        return self.tunnel_m - TUNNEL_M

    @property
    def tunnel(self) -> tuple[float, float]:
        return TUNNEL_X, TUNNEL_X + self.tunnel_m

    @property
    def field_x(self) -> float:
        return 245.0 + self.beyond_m

    @property
    def east(self) -> float:
        return 350.0 + self.beyond_m

    def roads(self) -> tuple[Road, ...]:
        """All roads of the town and round the field."""
        x, curve = self.field_x, 215.0 + self.beyond_m
        return (
            Road((-66, 0), (118, 0)),
            Road((118, 0), (curve, 0), town=False),
            Road((curve, 0), (x, 30), town=False, centre=(curve, 30)),
            Road((x, 30), (x, 120), town=False),
            Road((x, 120), (curve, 150), town=False, centre=(curve, 120)),
            Road((curve, 150), (-20, 150), town=False),
            Road((45, 150), (45, OPENING[1]), town=False),
            Road((45, OPENING[0]), (45, 0), town=False),
            Road((90, 0), (90, 90)),
            Road((115, 90), (-20, 90)),
            Road((0, 0), (0, 90)),
            Road((-66, 0), (-66, 0), town=False, centre=ROUNDABOUT),
        )

    def height(self, x: F8, y: F8) -> F8:
        return height(self, x, y)

    def on_deck(self, p: F8, d: F8) -> NDArray[np.bool_]:
        """The street along BRIDGE_X is driven southwards."""
        over = (p[:, 1] > OPENING[0] - 2) & (p[:, 1] < OPENING[1] + 2)
        return (np.abs(p[:, 0] - BRIDGE_X) < 4) & over & (d[:, 1] < -0.5)


def smoothstep(u: ArrayLike) -> F8:
    """0 to 1 over u in 0..1 with two continuous derivatives."""
    v = np.clip(np.asarray(u, float), 0, 1)
    out: F8 = v**3 * (10 - 15 * v + 6 * v**2)
    return out


def road_distance(plan: Layout, x: F8, y: F8) -> tuple[F8, NDArray[np.bool_]]:
    """Distance to the nearest centre line, m, and whether that road is one of the town."""
    best, town = np.full(np.shape(x), np.inf), np.zeros(np.shape(x), bool)
    for road in plan.roads():
        d = road.distance(x, y)
        nearer = d < best
        best, town = np.where(nearer, d, best), np.where(nearer, road.town, town)
    return best, town


def relief(x: F8, y: F8) -> F8:
    """Hills and hollows of the land before anything was built, m."""
    return 1.5 * np.sin(x / 58 + 0.4) * np.cos(y / 71) + 0.5 * np.sin(x / 23 - y / 37) + 0.008 * x


def embankment(x: F8) -> F8:
    """1 on the ramps of the bridge, 0 beside them."""
    return 1 - smoothstep((np.abs(x - BRIDGE_X) - 5.5) / 5.0)


def height(plan: Plan, x: ArrayLike, y: ArrayLike) -> F8:
    """Height of the ground, m: relief, plateau in the north, ramps, underpass, road camber and kerbs."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    gentle = 60 * smoothstep((x - 112) / 70)
    plateau = RISE_M * smoothstep((y - 100 + gentle) / (45 + gentle))
    south, north = y < OPENING[0], y > OPENING[1]
    ramp = np.where(south, RISE_M * smoothstep((y - 8) / 68), np.where(north, RISE_M, 0.0))
    on_ramp = embankment(x) * (south | north) * (y > 0)
    dip = DIP_M * np.exp(-(((x - BRIDGE_X) / 18) ** 2)) * (1 - smoothstep((np.abs(y - NORTH_Y) - 5) / 5))
    return (
        relief(x, y) + plateau + on_ramp * (ramp - plateau) - dip * (1 - on_ramp) + road_profile(plan, x, y)
    )


def deck_height(x: ArrayLike, y: ArrayLike) -> F8:
    """Height of the road on the bridge, m."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    return relief(x, y) + RISE_M - 0.02 * np.minimum(np.abs(x - BRIDGE_X), 3.5)


def road_profile(plan: Layout, x: F8, y: F8) -> F8:
    """Camber of 2 % on the lanes, sidewalks 0.1 m above the road in town, verges 0.1 m below elsewhere."""
    d, town = road_distance(plan, x, y)
    camber = -0.02 * np.minimum(d, 3.5)
    kerb = np.where(town, 0.1 * smoothstep((d - 5.5) / 0.6), -0.1 * smoothstep((d - 4.2) / 1.5))
    return camber + kerb


@dataclass(frozen=True)
class Terrain:
    """The ground as a grid of heights, and a raster of what it is made of."""

    z: NDArray[np.float32]
    """(rows, columns) height at the grid's corners, m; row 0 is the south."""
    material: NDArray[np.uint8]
    """(rows, columns) `Material` of each raster cell."""
    plan: Layout

    def height(self, x: F8, y: F8) -> F8:
        """Height of the ground as it was built, m: bilinear between the corners."""
        u = np.clip((x - WEST) / CELL_M, 0, self.z.shape[1] - 1.001)
        v = np.clip((y - SOUTH) / CELL_M, 0, self.z.shape[0] - 1.001)
        i, j = u.astype(int), v.astype(int)
        a, b = u - i, v - j
        z = self.z.astype(float)
        lower = z[j, i] * (1 - a) + z[j, i + 1] * a
        upper = z[j + 1, i] * (1 - a) + z[j + 1, i + 1] * a
        out: F8 = lower * (1 - b) + upper * b
        return out

    def mesh(self) -> Mesh:
        x: F8 = WEST + CELL_M * np.arange(self.z.shape[1], dtype=float)
        y: F8 = SOUTH + CELL_M * np.arange(self.z.shape[0], dtype=float)
        return grid_mesh(x, y, self.z.astype(float), Material.GRASS)


def build_terrain(rng: np.random.Generator, plan: Layout) -> Terrain:
    """The ground with rough grass; roads stay smooth."""
    x, y = np.meshgrid(np.arange(WEST, plan.east + 0.1, CELL_M), np.arange(SOUTH, NORTH + 0.1, CELL_M))
    d, _ = road_distance(plan, x, y)
    rough = 0.006 + 0.04 * smoothstep((d - 6) / 4)
    z = plan.height(x, y) + rough * rng.standard_normal(x.shape)
    return Terrain(z.astype(np.float32), _materials(plan), plan)


def _materials(plan: Layout) -> NDArray[np.uint8]:
    x, y = np.meshgrid(
        np.arange(WEST, plan.east, RASTER_M) + 0.125, np.arange(SOUTH, NORTH, RASTER_M) + 0.125
    )
    d, town = road_distance(plan, x, y)
    out = np.full(x.shape, Material.GRASS, np.uint8)
    out[town & (d < 8.2)] = Material.PAVING
    out[d < np.where(town, 5.7, 3.9)] = Material.ASPHALT
    dashes = (d < 0.13) & (np.mod(x + y, 9.0) < 4.0)
    edges = ~town & (np.abs(d - 3.4) < 0.13)
    out[dashes | edges] = Material.MARKING
    return out
