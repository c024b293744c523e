"""What moves: cars, a truck with its dust, a cyclist, pedestrians. Each follows the road and has a shape of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.se3 import F8, pose
from scanloom.stages.simulate.meshes import Material, Mesh, car, cyclist, person, truck
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.route import Path
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.terrain import LANE_M, Plan

ONCOMING_M = 2 * LANE_M
"""Offset of the other lane to the left, m."""
PAVEMENT_M = -5.0
CLEARANCE_M = 2.1
CONVOY = ("truck", "car behind")
"""They drive as the vehicle does."""
LEAD_S = 4.0
"""The truck drives this far ahead, s."""
DUST_AGES_S = np.arange(0.35, 3.0, 0.4)
DUSTY_M = 45.0
"""From this far before the field the road is dry earth."""


class Mover(Protocol):
    """A moving object."""

    @property
    def name(self) -> str:
        """Its own."""

    @property
    def what(self) -> str:
        """`car`, `truck`, `bus`, `cyclist`, `person`, `dog` or `pram`."""

    @property
    def mesh(self) -> Mesh:
        """Its shape, x forward, the origin on the ground."""

    def poses(self, path: Path, t: F8) -> F8:
        """T_world_mover (n, 4, 4) at times (n,) s."""

    def kind(self, t: float) -> PointClass:
        """What its points truly are at a time."""

    def present(self, t: F8) -> NDArray[np.bool_]:
        """Whether it is there at times (n,) s."""


@dataclass(frozen=True)
class Actor:
    """A moving object: its shape, and the arc length and offset to the left it has at a time."""

    name: str
    what: str
    mesh: Mesh
    arc: Callable[[F8], F8]
    """Arc length (n,) m at times (n,) s."""
    left_m: float
    backwards: bool = False
    """Drives against the direction of the path."""

    def kind(self, t: float) -> PointClass:
        return PointClass.DYNAMIC

    def present(self, t: F8) -> NDArray[np.bool_]:
        return np.ones(len(t), bool)

    def poses(self, path: Path, t: F8) -> F8:
        """T_world_actor (n, 4, 4)."""
        s = self.arc(t)
        tangent = path.at(s, 1)
        yaw = np.arctan2(tangent[:, 1], tangent[:, 0])
        p = path.at(s) + self.left_m * np.column_stack((-np.sin(yaw), np.cos(yaw), np.zeros(len(t))))
        yaw = yaw + (np.pi if self.backwards else 0.0)
        R = np.zeros((len(t), 3, 3))
        R[:, 0, 0], R[:, 0, 1] = np.cos(yaw), -np.sin(yaw)
        R[:, 1, 0], R[:, 1, 1] = np.sin(yaw), np.cos(yaw)
        R[:, 2, 2] = 1.0
        return pose(R, p)


def build_traffic(settings: Settings, path: Path, motion: Motion) -> list[Actor]:
    """Everybody on the road, in a fixed order; the first is the truck ahead."""
    if not settings.traffic:
        return []
    rng = np.random.default_rng((settings.seed, 11))

    def follow(lag_s: float, gap_m: float) -> Callable[[F8], F8]:
        """Drive like the own vehicle, earlier or later; at rest the centres are still `gap_m` apart."""
        return lambda t: np.asarray(motion.arc(t + lag_s), float) + gap_m

    def cruise(start_m: float, speed: float) -> Callable[[F8], F8]:
        return lambda t: start_m + speed * t

    def stroll(start_m: float, speed: float, phase: float) -> Callable[[F8], F8]:
        """There and back along 25 m of pavement."""
        return lambda t: start_m + 12.5 * np.sin(speed / 12.5 * t + phase)

    actors = [
        Actor("truck", "truck", truck(), follow(LEAD_S, 11.0), 0.0),
        Actor("car behind", "car", car(Material.PAINT_DARK), follow(-2.2, -6.0), 0.0),
    ]
    for k in range(9):
        start = path.length_m * (k + rng.uniform(0.1, 0.9)) / 9
        paint = Material.PAINT_LIGHT if k % 2 else Material.PAINT_DARK
        actors.append(
            Actor(f"oncoming {k}", "car", car(paint), cruise(start, -rng.uniform(5, 8)), ONCOMING_M, True)
        )
    actors.append(Actor("cyclist", "cyclist", cyclist(), cruise(35.0, 4.2), -2.2))
    for k in range(8):
        start = rng.uniform(0.0, 420.0)
        walk = stroll(start, rng.uniform(0.9, 1.5), rng.uniform(0, 6.28))
        actors.append(
            Actor(
                f"person {k}",
                "person",
                person(rng.uniform(0.15, 0.3)),
                walk,
                PAVEMENT_M - rng.uniform(0, 1.5),
            )
        )
    return [actor for actor in actors if _keeps_clear(actor, settings, path, motion)]


def _keeps_clear(actor: Actor, settings: Settings, path: Path, motion: Motion) -> bool:
    """Whether it never drives through the own vehicle; where lanes merge, constant speeds would."""
    t = np.arange(0.0, settings.duration_s, 0.2)
    own, other = motion.poses(t)[:, :3, 3], actor.poses(path, t)[:, :3, 3]
    apart = own + motion.poses(t)[:, :3, 0] - other
    return bool((np.linalg.norm(apart, axis=1) > CLEARANCE_M).all())


@dataclass(frozen=True)
class Puff:
    """A ball of dust: centre (3,), radius m, extinction 1/m."""

    centre: F8
    radius_m: float
    extinction: float


def dust(settings: Settings, path: Path, actors: Sequence[Mover], t: float) -> list[Puff]:
    """What the truck's wheels raised on the field within the last seconds: it spreads and thins out."""
    if not actors or settings.dust_per_m == 0:
        return []
    poses = actors[0].poses(path, t - DUST_AGES_S)
    dusty_x = Plan(settings.tunnel_m).field_x - DUSTY_M
    puffs = []
    for age, T in zip(DUST_AGES_S, poses):
        if T[0, 3] < dusty_x:
            continue
        centre = T[:3, 3] + np.array([0.3 * age, 0.8 * age, 0.5 + 0.25 * age])
        puffs.append(Puff(centre, 1.0 + 0.7 * age, settings.dust_per_m * float(np.exp(-age / 1.5))))
    return puffs
