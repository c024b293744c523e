"""A housing estate made to deceive: parallel streets with the same row houses in the same order, and one that repeats itself.

Streets run along x, `apart_m` from each other; the first is y = 0. Between West Street (x = WEST_X) and East Street stand
terraces, the same on every street. East of it every street repeats one block with its garden, tree and lamp again and again;
only the first is driven there, up to its turning circle. Streets differ by what differs in reality: parked cars, some
hedges, bushes and trees, and how the land rises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate import meshes
from scanloom.stages.simulate.meshes import Material, Mesh
from scanloom.stages.simulate.route import build_path
from scanloom.stages.simulate.terrain import (
    LANE_M,
    ROUNDABOUT_R,
    Road,
    build_terrain,
    road_profile,
)
from scanloom.stages.simulate.town import Free, Town

WEST_X = -95.0
STREETS = (-1, 0, 1, 2, 3)
"""Numbers of the streets; 0 to 2 are driven, the others are the neighbours that every driven street has."""
BLOCKS = 6
"""How often the eastern part of a street repeats itself."""
CORNER_M = 10.0
"""From the middle of a crossing to the first house."""
CHANGED = 0.2
"""Share of hedges and trees that differ from street to street."""


@dataclass(frozen=True)
class EstatePlan:
    """Measures of an estate, m, and the phases of its hills, rad."""

    street_m: float
    """From West Street to East Street."""
    apart_m: float
    period_m: float
    phases: tuple[float, float, float]

    @classmethod
    def of(cls, town_seed: int) -> EstatePlan:
        rng = np.random.default_rng((town_seed, 5))
        street, apart, period = rng.uniform(78, 90), rng.uniform(43, 50), rng.uniform(26, 27.5)
        a, b, c = rng.uniform(0, 2 * np.pi, 3)
        return cls(float(street), float(apart), float(period), (float(a), float(b), float(c)))

    @property
    def east_x(self) -> float:
        """Middle of East Street."""
        return WEST_X + self.street_m

    @property
    def end_x(self) -> float:
        """Where the eastern parts end."""
        return self.east_x + CORNER_M + BLOCKS * self.period_m

    @property
    def circle(self) -> tuple[float, float]:
        """Middle of the turning circle."""
        return self.end_x + ROUNDABOUT_R, 0.0

    @property
    def east(self) -> float:
        return self.end_x + 60.0

    def roads(self) -> tuple[Road, ...]:
        first, last = STREETS[0] * self.apart_m, STREETS[-1] * self.apart_m
        streets = [Road((WEST_X, k * self.apart_m), (self.end_x, k * self.apart_m)) for k in STREETS]
        crossing = [Road((x, first), (x, last)) for x in (WEST_X, self.east_x)]
        end = (self.end_x, 0.0)
        return (*streets, *crossing, Road(end, end, town=False, centre=self.circle))

    def height(self, x: F8, y: F8) -> F8:
        a, b, c = self.phases
        hills = 0.6 * np.sin(x / 41 + a) * np.cos(y / 57 + b) + 0.25 * np.sin(x / 23 - y / 31 + c)
        out: F8 = hills + 0.006 * x + road_profile(self, x, y)
        return out

    def on_deck(self, p: F8, d: F8) -> NDArray[np.bool_]:
        return np.zeros(len(p), bool)


def estate_lap(plan: EstatePlan) -> F8:
    """Corners of the lap (n, 3): x, y and the radius of the turn, m.

    The first street eastwards and back, round its circle (opposite); East Street to the third street and that westwards;
    West Street down to the second, that eastwards (looks like the first); East Street and the third street again (same
    direction); West Street down to the first.
    """
    lane, west, east, apart, r = LANE_M, WEST_X, plan.east_x, plan.apart_m, ROUNDABOUT_R
    angles = np.radians(np.arange(215, 506, 10))
    cx, cy = plan.circle
    circle = np.column_stack((cx + r * np.cos(angles), cy + r * np.sin(angles), np.zeros(len(angles))))
    out = [[west + 12, -lane, 0], [cx - 15, -lane, 0]]
    north_west = [[east + lane, 2 * apart + lane, 9], [west - lane, 2 * apart + lane, 9]]
    back = [
        [cx - 15, lane, 0], [east + lane, lane, 7], *north_west, [west - lane, apart - lane, 9],
        [east + lane, apart - lane, 9], *north_west, [west - lane, -lane, 9],
    ]  # fmt: skip
    return np.vstack((out, circle, back))


def build_estate(town_seed: int, parking_seed: int) -> Town:
    """Ground, houses, fences, greenery, lamps, parked cars. Another parking seed is another day."""
    plan = EstatePlan.of(town_seed)
    rng = np.random.default_rng((town_seed, 7))
    terrain = build_terrain(rng, plan)
    town = Town(terrain, build_path(estate_lap(plan), terrain))
    town.add(terrain.mesh(), PointClass.GROUND)
    plots: list[F8] = []
    sides = [_Side(plan, rng, side) for side in (1.0, -1.0)]
    free = Free(plan, town.path, plots)
    for number in STREETS:
        for side in sides:
            plots += side.build(town, number * plan.apart_m)
    for number in STREETS:
        for side in sides:
            side.furnish(town, number * plan.apart_m, rng, free)
    plots += _west_side(town, plan, rng)
    _fences(town, plan)
    _greenery(town, plan, rng, free)
    _parked_cars(town, plan, np.random.default_rng((town_seed, 6, parking_seed)))
    return town


@dataclass(frozen=True)
class _House:
    """A house of a row: its mesh, where its middle stands along the row, and how far back from the street's middle, m."""

    mesh: Mesh
    along_m: float
    setback_m: float
    width_m: float
    depth_m: float


def _terrace(rng: np.random.Generator, length_m: float) -> list[_House]:
    """Blocks of two to five equal houses wall to wall, with gaps, along a street."""
    houses: list[_House] = []
    u = rng.uniform(0, 2)
    while u < length_m - 12:
        width, depth, setback = rng.uniform(5.4, 6.6), rng.uniform(8.0, 9.5), 9.2 + rng.uniform(0, 2.5)
        mesh = meshes.house(rng, width, depth, rng.uniform(4.8, 6.4))
        for _ in range(min(int(rng.integers(2, 6)), int((length_m - u) / width))):
            houses.append(_House(mesh, u + width / 2, setback, width, depth))
            u += width
        u += rng.uniform(2.5, 7.5)
    return houses


def _repeated(rng: np.random.Generator, period_m: float) -> list[_House]:
    """One block of houses after the other, all the same."""
    block = [house for house in _terrace(rng, period_m - 3.0) if house.along_m < period_m - 5.5]
    shifted = [(house, k * period_m) for k in range(BLOCKS) for house in block]
    return [_House(h.mesh, h.along_m + u, h.setback_m, h.width_m, h.depth_m) for h, u in shifted]


def _placed(town: Town, houses: list[_House], start: F8, along: F8, across: F8) -> list[F8]:
    """Put a row of houses along a line; returns their outlines as corner pairs."""
    yaw = float(np.arctan2(across[1], across[0]) - np.pi / 2)
    plots = []
    for house in houses:
        front = start + along * house.along_m + across * house.setback_m
        town.put(house.mesh, float(front[0]), float(front[1]), yaw, thing="house")
        ends = (front - along * house.width_m / 2, front + along * house.width_m / 2 + across * house.depth_m)
        plots.append(np.sort(np.array(ends), axis=0))
    return plots


class _Side:
    """What stands on one side of every street, again and again."""

    def __init__(self, plan: EstatePlan, rng: np.random.Generator, side: float) -> None:
        self._across = np.array([0.0, side])
        self._west, self._east = WEST_X + CORNER_M, plan.east_x + CORNER_M
        self._terrace = _terrace(rng, plan.street_m - 2 * CORNER_M)
        self._repeated = _repeated(rng, plan.period_m)
        self._lamps = [*np.arange(6 + 9 * (side > 0), plan.street_m - 2 * CORNER_M, 24.0)]
        steps = plan.period_m * np.arange(BLOCKS)
        self._east_lamps = steps + rng.uniform(2, 8)
        self._trees = [
            (float(x), meshes.tree(rng), rng.uniform(6.7, 7.3))
            for x in np.arange(self._west + 4, plan.east_x - 14, 13.0) + rng.uniform(-2, 2)
            if rng.random() < 0.55
        ]
        tree, place = meshes.tree(rng), self._east + rng.uniform(10, 16)
        self._trees += [(float(place + u), tree, 7.0) for u in steps]
        self._gardens = self._front_gardens(rng)

    def _front_gardens(self, rng: np.random.Generator) -> list[tuple[float, Mesh]]:
        """Hedges and low walls in front of the houses: the same pick for the same house."""
        picks: dict[int, Mesh | None] = {}
        out = []
        for start, houses in ((self._west, self._terrace), (self._east, self._repeated)):
            for house in houses:
                kind = id(house.mesh) if start == self._east else len(picks)
                if kind not in picks:
                    picks[kind] = _garden(rng, house.width_m)
                mesh = picks[kind]
                if mesh is not None:
                    out.append((start + house.along_m, mesh))
        return out

    def build(self, town: Town, y: float) -> list[F8]:
        """The houses on this side of one street; returns their outlines."""
        along, plots = np.array([1.0, 0.0]), []
        for start, houses in ((self._west, self._terrace), (self._east, self._repeated)):
            plots += _placed(town, houses, np.array([start, y]), along, self._across)
        return plots

    def furnish(self, town: Town, y: float, rng: np.random.Generator, free: Free) -> None:
        """Lamps at equal places; trees and gardens of which a share differs from street to street."""
        side = float(self._across[1])
        yaw = np.pi / 2 * (1 - side)
        for x in (*(self._west + u for u in self._lamps), *(self._east + u for u in self._east_lamps)):
            if free(float(x), y + 6.3 * side, road_m=5.9):
                town.put(meshes.lamp(), float(x), y + 6.3 * side, yaw)
        for x, mesh, off in self._trees:
            changed, turn = rng.random() < CHANGED, rng.uniform(0, 2 * np.pi)
            other = meshes.tree(rng)
            if free(x, y + off * side, road_m=6.0):
                town.put(other if changed else mesh, x, y + off * side, turn if changed else 0.0)
        for x, usual in self._gardens:
            changed, own = rng.random() < CHANGED, _garden(rng, 5.5)
            kept = own if changed else usual
            if kept is not None and free(x, y + 8.5 * side, road_m=8.0):
                town.put(kept, x, y + 8.5 * side)


def _garden(rng: np.random.Generator, width_m: float) -> Mesh | None:
    """A hedge, a low wall or nothing."""
    pick, length = rng.random(), rng.uniform(0.5, 0.9) * width_m
    if pick < 0.4:
        return meshes.hedge(rng, length)
    if pick < 0.7:
        return meshes.box([-length / 2, -0.12, -1], [length / 2, 0.12, rng.uniform(0.5, 1.5)], Material.BRICK)
    return None


def _west_side(town: Town, plan: EstatePlan, rng: np.random.Generator) -> list[F8]:
    """Houses along the outer side of West Street, the same between every two streets."""
    houses = _terrace(rng, plan.apart_m - 2.0)
    along, across = np.array([0.0, 1.0]), np.array([-1.0, 0.0])
    plots = []
    for number in STREETS[:-1]:
        plots += _placed(town, houses, np.array([WEST_X, number * plan.apart_m + 1.0]), along, across)
    return plots


def _fences(town: Town, plan: EstatePlan) -> None:
    """Board fences between the back gardens of two streets."""
    board = meshes.box([-3.0, -0.04, -1.0], [3.0, 0.04, 1.7], Material.BARK)
    for number in STREETS[:-1]:
        y = (number + 0.5) * plan.apart_m
        for a, b in ((WEST_X + 14, plan.east_x - 14), (plan.east_x + 14, plan.end_x)):
            for x in np.arange(a + 3.0, b - 3.0, 6.0):
                town.put(board, float(x), y)


def _greenery(town: Town, plan: EstatePlan, rng: np.random.Generator, free: Free) -> None:
    """Trees and bushes in gardens, where nothing repeats, and the tree of the turning circle."""
    kinds = [meshes.tree(rng) for _ in range(8)]
    shrubs = [meshes.bush(rng) for _ in range(8)]
    low, high = STREETS[0] * plan.apart_m - 30, STREETS[-1] * plan.apart_m + 30
    for _ in range(150):
        x, y = float(rng.uniform(WEST_X - 40, plan.end_x + 40)), float(rng.uniform(low, high))
        shape = kinds[rng.integers(8)] if rng.random() < 0.35 else shrubs[rng.integers(8)]
        turn = rng.uniform(0, 2 * np.pi)
        if free(x, y, road_m=8.7):
            town.put(shape, x, y, turn)
    town.put(kinds[0], *plan.circle)


def _parked_cars(town: Town, plan: EstatePlan, rng: np.random.Generator) -> None:
    """Cars in about half of the bays of all streets."""
    path = cKDTree(town.path.at(np.arange(0, town.path.length_m, 0.5))[:, :2])
    paints = [Material.PAINT_DARK, Material.PAINT_LIGHT, Material.METAL]
    for number in STREETS:
        for side in (1.0, -1.0):
            for bay in np.arange(WEST_X + 13, plan.end_x - 8, 6.2):
                taken, paint, lean = rng.random() < 0.5, paints[rng.integers(3)], rng.normal(0, 0.02)
                length, tall, shift = rng.uniform(3.8, 4.9), rng.uniform(1.42, 1.9), rng.normal(0, 0.25)
                x, y = float(bay + shift), number * plan.apart_m + 4.65 * side
                if taken and abs(x - plan.east_x) > 12 and path.query((x, y))[0] > 2.2:
                    town.put(meshes.car(paint, length, tall), x, y, np.pi * (side > 0) + lean, thing="car")
