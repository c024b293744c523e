"""Where on the way there is room for something: free bays, garden walls and hedges."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.meshes import Material
from scanloom.stages.simulate.terrain import LANE_M
from scanloom.stages.simulate.town import Town

BAY_M = 4.65
"""From the middle of the road to that of a bay, m."""
CROSSING_M = 12.0
"""No bay so near to another road, m."""


def free_bay(town: Town, arc: float, before_m: float, behind_m: float) -> float | None:
    """Arc length near the given one beside which, on the other side of a street of the town, there is room.

    `before_m` and `behind_m`: no other parked car nearer, towards larger and smaller arc lengths.
    """
    path, plan = town.path, town.terrain.plan
    cars = np.array([thing.centre[:2] for thing in town.things if thing.what == "car"]).reshape(-1, 2)
    for off in sorted(range(-20, 24), key=abs):
        s = np.array([arc + off])
        p, heading = path.at(s)[0, :2], float(path.heading(s)[0])
        forward, aside = (
            np.array([np.cos(heading), np.sin(heading)]),
            np.array([-np.sin(heading), np.cos(heading)]),
        )
        middle = p + LANE_M * aside
        near = [r for r in plan.roads() if float(r.distance(*middle[:, None])[0]) < CROSSING_M]
        if len(near) != 1 or not near[0].town or near[0].distance(*middle[:, None])[0] > 0.5:
            continue
        place = cars - (middle + BAY_M * aside)
        along, across = place @ forward, np.abs(place @ aside)
        if not ((across < 2.5) & (along < before_m) & (along > -behind_m)).any():
            return arc + off
    return None


def wall_near(town: Town, arc: float) -> tuple[float, float] | None:
    """Arc length and offset to the left of the garden wall or hedge nearest to a place on the way."""
    s: F8 = arc + np.arange(-22.0, 22.0, 0.5)
    p, heading = town.path.at(s)[:, :2], town.path.heading(s)
    best, found = 12.0 + 22.0, None
    for part, (_, instance) in zip(town.parts, town.classes, strict=True):
        if (
            instance
            or len(part.triangles) > 4000
            or set(part.material.tolist()) - {Material.BRICK, Material.LEAF}
        ):
            continue
        size = np.ptp(part.vertices, axis=0)
        if not (size[:2].max() > 2.5 and size[:2].min() < 1.3):
            continue
        gap = part.vertices[:, :2].mean(axis=0) - p
        row = int(np.hypot(gap[:, 0], gap[:, 1]).argmin())
        left = float(gap[row] @ [-np.sin(heading[row]), np.cos(heading[row])])
        if 5.5 < abs(left) < 11.0 and abs(s[row] - arc) < best:
            best, found = abs(s[row] - arc), (float(s[row]), left)
    return found
