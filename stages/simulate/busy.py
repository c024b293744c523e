"""A busy day: what a filter of moving things finds hard. Those who stand for a while and leave, those who come to stay, and
those who move close to what stands.

Every STRIDE_M of the drive somebody of the cast appears, timed by when the vehicle passes; at the traffic light, where the
vehicle has to wait, a car stands on the other side and somebody crosses the road.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.guests import Aside, Footprint, Guest, clash, through
from scanloom.stages.simulate.meshes import Material, Mesh, bus, car, cyclist, dog, person, pram
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.places import BAY_M, free_bay, wall_near
from scanloom.stages.simulate.rig import vehicle
from scanloom.stages.simulate.route import Path, light_arc
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.terrain import LANE_M, smoothstep
from scanloom.stages.simulate.town import Town
from scanloom.stages.simulate.traffic import Actor, Mover

STRIDE_M, FIRST_M = 42.0, 28.0
KERB_M, PAVEMENT_M, ALONG_WALL_M = 3.1, 7.0, 0.75
"""Offsets from the middle of the road, and from the middle of a wall."""
ROUND_THE_CORNER_M = 34.0
SLIDE_M = 9.0
"""A car moves into its bay, or out of it, over this length."""
GRID_S = 0.2


@dataclass(frozen=True)
class Scene:
    """What a script needs to know: the town, the drive, and when the vehicle is where."""

    settings: Settings
    town: Town
    motion: Motion
    rng: np.random.Generator

    def passed(self, arc_m: float) -> float:
        """When the vehicle is at an arc length of its whole drive, s."""
        t = np.arange(-4.0, self.settings.duration_s + 4.0, 0.05)
        return float(np.interp(arc_m, np.asarray(self.motion.arc(t), float), t))

    def guest(
        self,
        name: str,
        what: str,
        mesh: Mesh,
        arc: Callable[[F8], F8],
        left: Aside,
        meets_s: float,
        *,
        backwards: bool = False,
        turn_rad: float = 0.0,
        stays_s: float = np.inf,
    ) -> Guest:
        ground = self.town.terrain
        return Guest(name, what, mesh, ground, arc, left, meets_s, backwards, turn_rad, stays_s=stays_s)


def build_guests(settings: Settings, town: Town, motion: Motion, convoy: Sequence[Mover]) -> list[Guest]:
    """Everybody of the cast who is in nobody's way: neither of the vehicle, nor of those who drive before and behind it
    (`convoy`), nor of another."""
    scene = Scene(settings, town, motion, np.random.default_rng((settings.seed, 12)))
    first = float(motion.arc(0.0)) + FIRST_M
    last = float(motion.arc(settings.duration_s))
    wanted = [[guest] for guest in _at_the_light(scene)]
    for k, arc in enumerate(np.arange(first, last, STRIDE_M)):
        wanted.append(CAST[k % len(CAST)](scene, float(arc), k))
    kept: list[Guest] = []
    taken = [_own(scene), *(footprint(settings, town.path, actor) for actor in convoy)]
    for group in wanted:
        there = [replace(guest, present_s=_in_reach(scene, guest)) for guest in group]
        marks = [footprint(settings, town.path, guest) for guest in there]
        if not any(clash(mark, other) for mark in marks for other in taken):
            kept += there
            taken += marks
    return kept


def giving_way(
    settings: Settings, path: Path, actors: Sequence[Actor], guests: Sequence[Guest]
) -> list[Actor]:
    """Those of the usual traffic who would drive into nobody of the cast."""
    marks = [footprint(settings, path, guest) for guest in guests]
    return [
        actor for actor in actors if not any(clash(mark, footprint(settings, path, actor)) for mark in marks)
    ]


def footprint(settings: Settings, path: Path, mover: Mover) -> Footprint:
    t = np.arange(0.0, settings.duration_s, GRID_S)
    size = np.ptp(mover.mesh.vertices, axis=0)
    return Footprint(mover.poses(path, t), (float(size[0]), float(size[1])), mover.present(t))


def _own(scene: Scene) -> Footprint:
    t = np.arange(0.0, scene.settings.duration_s, GRID_S)
    T, body = scene.motion.poses(t), vehicle().vertices
    T[:, :3, 3] += T[:, :3, 0] * float(body[:, 0].max() + body[:, 0].min()) / 2
    size = np.ptp(body, axis=0)
    return Footprint(T, (float(size[0]), float(size[1])), np.ones(len(t), bool))


def _in_reach(scene: Scene, guest: Guest) -> tuple[float, float]:
    """From when to when the guest is nearer than the LiDAR sees; it comes and goes unseen."""
    t = np.arange(-2.0, scene.settings.duration_s + 2.0, GRID_S)
    apart = guest.poses(scene.town.path, t)[:, :3, 3] - scene.motion.poses(t)[:, :3, 3]
    distance = np.linalg.norm(apart, axis=1)
    nearest = int(np.searchsorted(t, guest.meets_s))
    far = np.flatnonzero(distance > scene.settings.max_range_m + 15.0)
    before, after = far[far < nearest], far[far > nearest]
    return (
        float(t[before[-1]]) if len(before) else -np.inf,
        float(t[after[0]]) if len(after) and guest.stays_s == np.inf else np.inf,
    )


# ---------------------------------------------------------------------------------------------------------------------


def _at_the_light(scene: Scene) -> list[Guest]:
    """A car comes slowly down the street into which the vehicle turns, waits for 20 s in its view, and leaves as it turns;
    before, somebody crosses the road."""
    if scene.settings.route != "town":
        return []
    path, guests = scene.town.path, []
    line = light_arc(path)
    start, end = (float(scene.motion.arc(t)) for t in (0.0, scene.settings.duration_s - 5.0))
    for lap in range(int(end / path.length_m) + 1):
        stop = lap * path.length_m + line
        if not start + 8 < stop < end:
            continue
        t = scene.passed(stop - 0.6)
        corner = stop + ROUND_THE_CORNER_M
        until = scene.passed(corner) - 3.5
        guests.append(_waiting(scene, f"waiting at the light {lap}", corner, until - 20.0, until))
        crossing = through((t - 6.0, stop + 5.4), (t + 6.0, stop + 5.5))
        walk = _across((t - 5.5, LANE_M + 6.5), (t + 4.5, LANE_M - 6.5))
        someone = person(0.25)
        turn = -np.pi / 2
        guests.append(scene.guest(f"crossing {lap}", "person", someone, crossing, walk, t, turn_rad=turn))
    return guests


def _waiting(scene: Scene, name: str, arc: float, from_s: float, until_s: float) -> Guest:
    paint = Material.PAINT_DARK if scene.rng.random() < 0.5 else Material.PAINT_LIGHT
    track = through(
        (from_s - 14.0, arc + 55.0), (from_s - 3.0, arc + 4.0), (from_s, arc), (until_s, arc),
        (until_s + 3.0, arc - 6.5), (until_s + 8.0, arc - 38.0),
    )  # fmt: skip
    return scene.guest(name, "car", car(paint), track, _beside(2 * LANE_M), until_s + 4, backwards=True)


def _across(*stops: tuple[float, float]) -> Aside:
    """Across the road: offsets to the left m at times s."""
    track = through(*stops)
    return lambda s, t: track(t)


def _beside(left_m: float) -> Aside:
    return lambda s, t: np.full(len(s), left_m)


def _waiter(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A car on the other lane stands for 16 s and leaves before the vehicle has passed."""
    t = scene.passed(arc)
    return [_waiting(scene, f"waiting {k}", arc + 8.0, t - 19.0, t - 3.0)]


def _parking(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A car comes along the other lane, moves into a free bay, and stays."""
    bay = free_bay(scene.town, arc, before_m=12.0, behind_m=5.6)
    if bay is None:
        return []
    t = scene.passed(bay) - 1.5
    track = through((t - 12.0, bay + 72.0), (t - 3.0, bay + 7.0), (t, bay), (t + 1.0, bay))
    left = _slide(bay, SLIDE_M, LANE_M + BAY_M, 2 * LANE_M)
    shape = car(Material.PAINT_LIGHT if k % 2 else Material.PAINT_DARK)
    return [scene.guest(f"parking {k}", "car", shape, track, left, t + 1.5, backwards=True, stays_s=t)]


def _leaving(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A parked car leaves its bay before the vehicle has passed."""
    bay = free_bay(scene.town, arc, before_m=5.6, behind_m=12.0)
    if bay is None:
        return []
    t = scene.passed(bay) - 5.0
    track = through(
        (t - 20.0, bay), (t, bay), (t + 3.5, bay - 7.0), (t + 8.0, bay - 34.0), (t + 9.0, bay - 41.0)
    )
    left = _slide(bay - SLIDE_M, SLIDE_M, 2 * LANE_M, LANE_M + BAY_M)
    return [scene.guest(f"leaving {k}", "car", car(Material.METAL), track, left, t + 5.0, backwards=True)]


def _slide(start_m: float, over_m: float, left_m: float, then_m: float) -> Aside:
    """From one offset to another over a stretch of road."""
    return lambda s, t: left_m + (then_m - left_m) * smoothstep((s - start_m) / over_m)


def _bus(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A bus on the other lane halts for 6 s while the vehicle passes, and drives on."""
    t = scene.passed(arc)
    track = through(
        (t - 16.0, arc + 90.0), (t - 6.0, arc + 10.0), (t - 3.0, arc), (t + 3.0, arc),
        (t + 7.0, arc - 10.0), (t + 13.0, arc - 50.0),
    )  # fmt: skip
    return [scene.guest(f"bus {k}", "bus", bus(), track, _beside(2 * LANE_M + 0.1), t, backwards=True)]


def _passing(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A car comes along the other lane."""
    t, pace = scene.passed(arc), scene.rng.uniform(6.0, 9.5)
    paint = Material.PAINT_DARK if scene.rng.random() < 0.5 else Material.METAL
    track = through((t, arc), (t + 1.0, arc - pace))
    left = _beside(2 * LANE_M)
    return [scene.guest(f"passing {k}", "car", car(paint), track, left, t, backwards=True)]


def _by_the_kerb(scene: Scene, arc: float, k: int) -> list[Guest]:
    """A cyclist close to the parked cars on the other side, who stops for 3 s."""
    t = scene.passed(arc)
    track = through((t - 16.0, arc + 43.0), (t - 6.0, arc + 7.0), (t - 3.0, arc + 7.0), (t + 8.0, arc - 32.0))
    left = LANE_M + KERB_M
    return [scene.guest(f"kerb {k}", "cyclist", cyclist(), track, _beside(left), t, backwards=True)]


def _standing(scene: Scene, arc: float, k: int) -> list[Guest]:
    """Somebody stands on the pavement for 10 s while the vehicle passes, and walks on."""
    t, pace = scene.passed(arc), scene.rng.uniform(1.0, 1.5)
    track = through(
        (t - 16.0, arc + 10.0 * pace), (t - 6.0, arc), (t + 4.0, arc), (t + 14.0, arc - 10.0 * pace)
    )
    aside = -PAVEMENT_M - LANE_M + 2 * LANE_M if k % 2 else PAVEMENT_M + LANE_M
    return [scene.guest(f"standing {k}", "person", person(0.2), track, _beside(aside), t, backwards=True)]


def _with_dog(scene: Scene, arc: float, k: int) -> list[Guest]:
    return _along_wall(scene, arc, f"dog {k}", "dog")


def _with_pram(scene: Scene, arc: float, k: int) -> list[Guest]:
    return _along_wall(scene, arc, f"pram {k}", "pram")


def _along_wall(scene: Scene, arc: float, name: str, what: str) -> list[Guest]:
    """Somebody with a dog or a pram a foot from a garden wall or hedge, while the vehicle passes."""
    found = wall_near(scene.town, arc)
    if found is None:
        return []
    at, left = found
    left -= np.sign(left) * ALONG_WALL_M
    t = scene.passed(at)
    pace = scene.rng.uniform(0.9, 1.4)
    walk = through((t - 10.0, at - 10.0 * pace), (t + 10.0, at + 10.0 * pace))
    ahead = 0.9 if what == "pram" else 0.3
    aside = left if what == "pram" else left - np.sign(left) * 0.5
    other = pram() if what == "pram" else dog()
    return [
        scene.guest(f"with {name}", "person", person(0.2), walk, _beside(left), t),
        scene.guest(name, what, other, lambda at_s: walk(at_s) + ahead, _beside(aside), t),
    ]


CAST = (
    _standing, _parking, _with_dog, _waiter, _bus, _passing, _by_the_kerb, _leaving, _with_pram, _passing,
)  # fmt: skip
