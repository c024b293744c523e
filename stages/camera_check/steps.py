"""Steps of a scan: neighbouring rays, and whether a surface goes on between them, changes its reflectance, or ends.

What is told of a place by its reflectance alone is told by its grey too, but for light and shadow, which lie on the
same side of everything. Where something ends both change at once, whatever the light: so steps are compared with steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import DeskewedScan
from scanloom.stages.geometry.range_image import ImageSettings, range_image
from scanloom.stages.geometry.se3 import F8

I8 = NDArray[np.int64]
B1 = NDArray[np.bool_]

STEEPEST = 1.3
"""Ratio of ranges of two neighbours on one surface."""
LEVEL = 0.04
"""Range over what the surface would have there, less 1, of a neighbour that belongs to it."""
GAP, GAP_M = 0.08, 0.4
"""By so much more the neighbour of an edge is farther away."""
OPEN_M = 40.0
"""A surface that would go on nearer than that, and is not seen to, ends."""
MARK_TIMES, EVEN_TIMES = 6.0, 2.0
"""Times the median change of reflectance between neighbours on a surface: more is a mark, less is nothing."""


EMPTY, BEYOND = -1, -2
"""Cells without point, and those there are none of."""


class Kind(IntEnum):
    """What is between two neighbouring rays."""

    EVEN = 0
    """A surface that goes on, and looks alike."""
    MARK = 1
    """A surface that goes on with another reflectance."""
    EDGE = 2
    """It ends before another one."""
    OPEN = 3
    """It ends before nothing that was measured."""


@dataclass(frozen=True)
class Steps:
    """Pairs (n,) of neighbouring rays: both places as measured where one surface goes on between them; where it ends both at
    the range of the nearer, as there a camera beside the LiDAR sees the end."""

    near: F8
    """(n, 3) m in the LiDAR's axes: measured."""
    beside: F8
    """(n, 3) m: on the neighbouring ray."""
    kind: I8
    across: I8
    """0 between columns, 1 between rows of the scan."""


@dataclass(frozen=True)
class _Cloud:
    """A scan with two rows more: last for cells without point (number -1), before it for what lies beyond the outer beams."""

    xyz: F8
    far: F8
    light: F8
    """Logarithm of the reflectance."""
    usable: B1


def steps(scan: DeskewedScan, usable: B1) -> Steps:
    """All steps between points that are `usable` (n,), both ways along rows and columns of the scan."""
    everything = np.ones(len(scan.x_m), bool)
    image = range_image(ImageSettings(), scan.x_m, scan.y_m, scan.z_m, everything, everything)
    cells = image.point.reshape(len(image.elevation_rad), -1).astype(np.int64)
    cloud = _cloud(scan, usable)
    found = [_aside(cells, cloud, across, side) for across in (0, 1) for side in (1, -1)]
    return Steps(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _cloud(scan: DeskewedScan, usable: B1) -> _Cloud:
    xyz = np.vstack((scan.points().astype(float), np.full((2, 3), np.nan)))
    far = np.linalg.norm(xyz, axis=1)
    bright = np.append(np.maximum(scan.intensity, 0.0), (np.nan, np.nan)).astype(float)
    usual = float(np.median(bright[bright > 0])) if (bright > 0).any() else 1.0
    return _Cloud(xyz, far, np.log(bright + 0.02 * usual), np.append(usable, (False, False)))


def _aside(cells: I8, cloud: _Cloud, across: int, side: int) -> tuple[F8, F8, I8, I8]:
    """Steps from every cell to the one beside it; surfaces that go on only one way, since they are the same from both."""
    ahead, behind = _moved(cells, side, across), _moved(cells, -side, across)
    rows = np.flatnonzero((cells >= 0) & cloud.usable[cells])
    here, ahead, behind = cells.flat[rows], ahead.flat[rows], behind.flat[rows]
    beyond = _moved(cells, 2 * side, across).flat[rows]
    kind = _kinds(cloud, here, ahead, behind, beyond, across)
    if side < 0:
        kind[(kind == Kind.EVEN) | (kind == Kind.MARK)] = -1
    use = kind >= 0
    here, kind = here[use], kind[use]
    beside = _beside(cloud, here, ahead[use], behind[use], kind)
    return cloud.xyz[here], beside, kind, np.full(len(here), across)


def _moved(cells: I8, by: int, across: int) -> I8:
    """The cell `by` columns (rows if `across`) on; columns go round, -2 beyond the first and the last row."""
    moved = np.roll(cells, -by, axis=1 - across)
    if across:
        moved[-by if by > 0 else 0 : None if by > 0 else -by] = BEYOND
    return moved


def _kinds(cloud: _Cloud, here: I8, ahead: I8, behind: I8, beyond: I8, across: int) -> I8:
    """`Kind` of each, -1 for none. Along a plane the inverse of the range is linear (in the angle, for small ones)."""
    far, near, back = cloud.far[ahead], cloud.far[here], cloud.far[behind]
    with np.errstate(invalid="ignore", divide="ignore"):
        known = (back < STEEPEST * near) & (near < STEEPEST * back)
        inverse = np.where(known, 2.0 / near - 1.0 / back, np.nan if across else 1.0 / near)
        ratio = far * inverse
        both = cloud.usable[ahead]
        edge = both & (ratio > 1.0 + GAP) & (far > 1.0 / inverse + GAP_M)
        open_ = known & (ahead == EMPTY) & (beyond < 0) & (inverse * OPEN_M > 1.0)
        level = both & known & (np.abs(ratio - 1.0) < LEVEL)
        change = np.abs(cloud.light[ahead] - cloud.light[here])
    usual = float(np.median(change[level])) if level.any() else 0.0
    kind = np.full(len(here), -1)
    kind[level & (change <= EVEN_TIMES * usual)] = Kind.EVEN
    kind[level & (change > MARK_TIMES * usual) & (usual > 0)] = Kind.MARK
    kind[edge], kind[open_] = Kind.EDGE, Kind.OPEN
    return kind


def _beside(cloud: _Cloud, here: I8, ahead: I8, behind: I8, kind: I8) -> F8:
    """What was measured ahead on the same surface; for a surface that ends, at the range of here on the ray ahead, or on one
    as far from here as that behind."""
    direction = cloud.xyz[ahead] / cloud.far[ahead, None]
    opens = kind == Kind.OPEN
    before, last = here[opens], behind[opens]
    direction[opens] = (
        2.0 * cloud.xyz[before] / cloud.far[before, None] - cloud.xyz[last] / cloud.far[last, None]
    )
    goes_on = (kind == Kind.EVEN) | (kind == Kind.MARK)
    return np.asarray(np.where(goes_on, cloud.far[ahead], cloud.far[here])[:, None] * direction)
