"""The town: what stands where. The same seed builds the same town; another parking seed parks other cars."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate import meshes
from scanloom.stages.simulate.meshes import Material, Mesh
from scanloom.stages.simulate.route import Path, build_path, town_lap
from scanloom.stages.simulate.structures import bridge
from scanloom.stages.simulate.terrain import (
    BRIDGE_X,
    EAST_X,
    NORTH_Y,
    ROUNDABOUT,
    TUNNEL_M,
    TUNNEL_X,
    Layout,
    Plan,
    Terrain,
    build_terrain,
    embankment,
    road_distance,
)
from scanloom.stages.simulate.tunnel import tunnel


@dataclass(frozen=True)
class Street:
    """A straight street with houses: start, direction (unit), length, height range of its houses, gap range, m."""

    start: tuple[float, float]
    direction: tuple[float, float]
    length_m: float
    tall_m: tuple[float, float]
    gap_m: tuple[float, float]
    setback_m: tuple[float, float]


STREETS = (
    Street((-56, 0), (1, 0), 168, (5, 8.5), (2, 9), (9.5, 14)),
    Street((0, 10), (0, 1), 72, (6, 9), (1.5, 6), (9, 12)),
    Street((-16, NORTH_Y), (1, 0), 128, (5, 8), (3, 12), (9.5, 14)),
    Street((EAST_X, 8), (0, 1), 78, (17, 23), (0.5, 2), (8.7, 9.2)),
    Street((-15, 150), (1, 0), 75, (4, 7), (12, 30), (12, 20)),
)


@dataclass(frozen=True)
class Thing:
    """A single object that stands about: its box above the ground."""

    what: str
    centre: F8
    """(3,) m"""
    yaw_rad: float
    size_m: F8
    """(3,) length, width and height along its own axes."""

    @classmethod
    def of(cls, what: str, mesh: Mesh, foot: F8, yaw_rad: float) -> Thing:
        """The box of a mesh that was put somewhere; foundations do not count."""
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        low[2] = 0.0
        middle = Mesh((low + high)[None] / 2, mesh.triangles[:0], mesh.material[:0])
        return cls(what, middle.moved(foot, yaw_rad).vertices[0], yaw_rad, high - low)


@dataclass
class Town:
    """All triangles of what does not move, with what they are."""

    terrain: Terrain
    path: Path
    parts: list[Mesh] = field(default_factory=list)
    classes: list[tuple[int, int]] = field(default_factory=list)
    """(class, instance) of each part."""
    things: list[Thing] = field(default_factory=list)
    """What has a number of its own, in the order of the numbers, from 1."""

    @property
    def instances(self) -> int:
        return len(self.things)

    def add(self, mesh: Mesh, kind: PointClass = PointClass.STATIC, instance: int = 0) -> None:
        self.parts.append(mesh)
        self.classes.append((int(kind), instance))

    def put(self, mesh: Mesh, x: float, y: float, yaw_rad: float = 0.0, *, thing: str = "") -> None:
        """Stand a mesh on the ground; a `thing` gets a number of its own."""
        foot = np.array([x, y, float(self.terrain.height(np.array(x), np.array(y)))])
        if thing:
            self.things.append(Thing.of(thing, mesh, foot, yaw_rad))
        self.add(mesh.moved(foot, yaw_rad), instance=self.instances if thing else 0)

    def triangles(self) -> tuple[Mesh, NDArray[np.uint8], NDArray[np.uint16]]:
        """One mesh, and class and instance of each of its triangles."""
        counts = [len(part.triangles) for part in self.parts]
        kind, instance = np.array(self.classes).T
        return (
            meshes.joined(self.parts),
            np.repeat(kind, counts).astype(np.uint8),
            np.repeat(instance, counts).astype(np.uint16),
        )


def build_town(town_seed: int, parking_seed: int, tunnel_m: float = TUNNEL_M) -> Town:
    """Terrain, structures, houses, greenery, street furniture, parked cars."""
    plan = Plan(tunnel_m)
    rng = np.random.default_rng((town_seed, 1))
    terrain = build_terrain(rng, plan)
    town = Town(terrain, build_path(town_lap(plan), terrain))
    town.add(terrain.mesh(), PointClass.GROUND)
    for mesh, kind in (*bridge(), *tunnel(plan)):
        town.add(mesh, kind)
    plots = _houses(town, plan, rng)
    free = Free(plan, town.path, plots)
    _furniture(town, rng, free)
    _greenery(town, plan.beyond_m, rng, free)
    _parked_cars(town, np.random.default_rng((town_seed, 2, parking_seed)))
    return town


class Free:
    """Where something may stand: off the driven path, off the houses."""

    def __init__(self, plan: Layout, path: Path, plots: list[F8]) -> None:
        self._plan = plan
        self._path = cKDTree(path.at(np.arange(0, path.length_m, 0.5))[:, :2])
        self._plots = plots

    def __call__(self, x: float, y: float, *, path_m: float = 2.6, road_m: float = 4.0) -> bool:
        if (
            self._path.query((x, y))[0] < path_m
            or road_distance(self._plan, np.array(x), np.array(y))[0] < road_m
        ):
            return False
        return not any(_inside(plot, x, y) for plot in self._plots)


def _inside(plot: F8, x: float, y: float) -> bool:
    return bool(plot[0, 0] - 0.3 < x < plot[1, 0] + 0.3 and plot[0, 1] - 0.3 < y < plot[1, 1] + 0.3)


def _houses(town: Town, plan: Plan, rng: np.random.Generator) -> list[F8]:
    """Rows of houses on both sides of every street; returns their outlines as corner pairs."""
    plots: list[F8] = []
    for street in STREETS:
        along = np.array(street.direction, float)
        for side in (1.0, -1.0):
            across = side * np.array([-along[1], along[0]])
            u = rng.uniform(0, 4)
            while u < street.length_m - 8:
                width, depth, setback = rng.uniform(7, 13), rng.uniform(8, 10), rng.uniform(*street.setback_m)
                front = np.array(street.start) + along * (u + width / 2) + across * setback
                corners = np.array([front - along * width / 2, front + along * width / 2 + across * depth])
                plot = np.sort(corners, axis=0)
                mesh = meshes.house(rng, width, depth, rng.uniform(*street.tall_m))
                if _buildable(plan, plot, plots):
                    yaw = np.arctan2(across[1], across[0]) - np.pi / 2
                    town.put(mesh, float(front[0]), float(front[1]), float(yaw), thing="house")
                    plots.append(plot)
                u += width + rng.uniform(*street.gap_m)
    return plots


def _buildable(plan: Plan, plot: F8, plots: list[F8]) -> bool:
    x, y = np.meshgrid(*(np.linspace(low, high, 5) for low, high in plot.T))
    if road_distance(plan, x, y)[0].min() < 8.3 or ((embankment(x) > 0.02) & (y > 5) & (y < 160)).any():
        return False
    if (plot[1, 0] > TUNNEL_X - 4 and plot[0, 1] < 40) or np.hypot(x - ROUNDABOUT[0], y).min() < 18:
        return False
    return not any((plot[0] < other[1] + 0.4).all() and (other[0] < plot[1] + 0.4).all() for other in plots)


def _furniture(town: Town, rng: np.random.Generator, free: Free) -> None:
    """Street lamps, signs, walls and hedges in front of gardens."""
    for number, street in enumerate(STREETS):
        along = np.array(street.direction, float)
        for side in (1.0, -1.0):
            across = side * np.array([-along[1], along[0]])
            yaw = float(np.arctan2(across[1], across[0]) + np.pi / 2)
            for u in np.arange(6 + 9 * (side > 0), street.length_m, 27.0):
                x, y = np.array(street.start) + along * u + across * 6.3
                if free(x, y, road_m=5.9):
                    town.put(meshes.lamp(), x, y, yaw + np.pi)
            for u in rng.uniform(0, street.length_m, 4):
                x, y = np.array(street.start) + along * u + across * 6.1
                if free(x, y, road_m=5.8):
                    town.put(meshes.sign(), x, y, float(np.arctan2(along[1], along[0])) + np.pi * (side < 0))
            for u in np.arange(0, street.length_m, 11.0):
                x, y = np.array(street.start) + along * (u + rng.uniform(0, 3)) + across * 8.45
                pick, length = rng.random(), rng.uniform(3, 8)
                if number == 3 or not free(x, y, road_m=8.0) or embankment(np.array(x)) > 0.02:
                    continue
                if pick < 0.3:
                    town.put(meshes.hedge(rng, length), x, y, yaw)
                elif pick < 0.55:
                    wall = meshes.box(
                        [-length / 2, -0.12, -1], [length / 2, 0.12, rng.uniform(0.6, 1.8)], Material.BRICK
                    )
                    town.put(wall, x, y, yaw)


def _greenery(town: Town, beyond: float, rng: np.random.Generator, free: Free) -> None:
    """Trees along the streets and in gardens, bushes, an island with a tree, and little on the field."""
    kinds = [meshes.tree(rng) for _ in range(12)]
    shrubs = [meshes.bush(rng) for _ in range(8)]
    for street in STREETS[:3]:
        along = np.array(street.direction, float)
        for side in (1.0, -1.0):
            across = side * np.array([-along[1], along[0]])
            for u in np.arange(3, street.length_m, 13.0) + rng.uniform(-3, 3):
                x, y = np.array(street.start) + along * u + across * rng.uniform(6.6, 7.6)
                if rng.random() < 0.6 and free(x, y, road_m=6.0):
                    town.put(kinds[rng.integers(12)], x, y, rng.uniform(0, 6.3))
    for _ in range(170):
        x, y = rng.uniform(-110, 115), rng.uniform(-45, 200)
        shape = kinds[rng.integers(12)] if rng.random() < 0.45 else shrubs[rng.integers(8)]
        turn = rng.uniform(0, 6.3)
        if free(x, y, road_m=8.5):
            town.put(shape, x, y, turn)
    town.put(kinds[0], *ROUNDABOUT)
    for _ in range(10):
        x, y = rng.uniform(205 + beyond, 330 + beyond), rng.uniform(10, 190)
        if free(x, y, road_m=9):
            town.put(shrubs[rng.integers(8)], x, y)
    town.put(kinds[1], 262.0 + beyond, 88.0)
    post = meshes.cylinder([0, 0, -0.3], [0, 0, 1.0], 0.06, Material.RETRO, 6)
    for y in np.arange(35, 120, 25.0):
        town.put(post, 240.2 + beyond, float(y))


def _parked_cars(town: Town, rng: np.random.Generator) -> None:
    """Cars in about half of the bays along the streets of the town, but for the one of high houses."""
    path = cKDTree(town.path.at(np.arange(0, town.path.length_m, 0.5))[:, :2])
    paints = [Material.PAINT_DARK, Material.PAINT_LIGHT, Material.METAL]
    for street in STREETS[:3]:
        along = np.array(street.direction, float)
        for side in (1.0, -1.0):
            across = side * np.array([-along[1], along[0]])
            for u in np.arange(8, street.length_m - 6, 6.3):
                taken, paint, lean = rng.random() < 0.55, paints[rng.integers(3)], rng.normal(0, 0.02)
                length, tall, shift = rng.uniform(3.8, 4.9), rng.uniform(1.42, 1.9), rng.normal(0, 0.25)
                x, y = np.array(street.start) + along * (u + shift) + across * 4.65
                crossing = (
                    min(abs(x), abs(x - EAST_X), abs(x - BRIDGE_X))
                    if along[0]
                    else min(abs(y), abs(y - NORTH_Y))
                )
                if taken and crossing > 12 and path.query((x, y))[0] > 2.2:
                    heading = float(np.arctan2(along[1], along[0])) + np.pi * (side > 0) + lean
                    town.put(meshes.car(paint, length, tall), x, y, heading, thing="car")
