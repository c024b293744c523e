"""Segments of a scan: neighbours in the range image that belong to one surface, by angle and by intensity.

STV-SC (Tian et al. 2022; methods 2.3): breadth-first labelling with the angle criterion of Bogoslavskyi and Stachniss,
relaxed between points of like intensity. Ground is left out beforehand: denoise has named it. What remains in pieces of a
few points, leaves above all, is no structure and is dropped.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.range_image import F4, I4, RangeImage
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

B1 = NDArray[np.bool_]
I8 = NDArray[np.int64]

RULES = {"plain": 0, "hard": 1, "linear": 2}
LEAST_COSINE = 0.1


class SegmentationSettings(BaseModel):
    """When neighbours belong together, and which segments count."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    angle_deg: float = Field(
        default=60.0,
        gt=5,
        lt=90,
        description="theta: neighbours belong together when the line through them meets the beam at more than this, deg",
    )
    rule: Literal["plain", "hard", "linear"] = Field(
        default="linear",
        description="how like intensity relaxes the angle: not; by all of `relaxation_deg`; by its share of likeness",
    )
    relaxation_deg: float = Field(
        default=10.0, ge=0, lt=60, description="a: the angle is relaxed by up to this, deg"
    )
    alike: float = Field(
        default=1.0,
        gt=0,
        le=100,
        description="b: intensities that differ by less than this are alike, medians",
    )
    max_difference: float = Field(
        default=0.5,
        gt=0,
        le=1e6,
        description="neighbours whose intensities differ by more are two segments, medians of the scan",
    )
    reference_range_m: float = Field(
        default=10.0, gt=0, le=200, description="range at which intensity is taken as it is, m"
    )
    range_power: float = Field(
        default=2.0,
        ge=0,
        le=4,
        description="intensity falls with this power of range; 0 for sensors that report calibrated reflectivity",
    )
    max_intensity: float = Field(
        default=10.0, gt=0, le=1e6, description="intensities are clipped here, medians of the scan"
    )
    gap_cells: int = Field(
        default=1, ge=0, le=8, description="empty cells that are looked over to find a neighbour, number"
    )
    min_points: int = Field(
        default=30, ge=1, le=10_000, description="a segment of so many points counts, number"
    )
    min_tall_points: int = Field(
        default=5, ge=1, le=10_000, description="so does one of this many points if it is tall, number"
    )
    min_rows: int = Field(default=3, ge=1, le=256, description="tall: over this many rows, number")


def segments(settings: SegmentationSettings, image: RangeImage, xyz: F4, intensity: F4) -> I4:
    """Label (rows, columns) of each cell from 1; 0 where there is no point or its segment does not count.

    Parameters
    ----------
    xyz, intensity : (n, 3) m and (n,) of the points of the scan that the image shows.
    """
    brightness = calibrated(settings, image, xyz, intensity)
    label = np.zeros(image.point.shape, np.int32)
    sizes = _label(
        image.point, image.range_m, brightness, image.elevation_rad, image.column_rad, _rule(settings),
        settings.gap_cells, label,
    )  # fmt: skip
    points, rows = sizes[:, 0], sizes[:, 1]
    counts = (points >= settings.min_points) | (
        (points >= settings.min_tall_points) & (rows >= settings.min_rows)
    )
    kept = np.where(counts, np.cumsum(counts), 0).astype(np.int32)
    return np.concatenate((np.zeros(1, np.int32), kept))[label]


def calibrated(settings: SegmentationSettings, image: RangeImage, xyz: F4, intensity: F4) -> F4:
    """I (r / r_ref)^p / cos(incidence) of each cell over the median of the scan, clipped; NaN where it is not known.

    The incidence is that on the plane through a point and its nearer neighbours beside and above or below. A scan
    without intensities is NaN throughout: then the angle alone decides.
    """
    strength = _strength(
        image.point, image.range_m, xyz, intensity, settings.reference_range_m, settings.range_power
    )
    known = strength[np.isfinite(strength)]
    median = float(np.median(known)) if len(known) else 0.0
    if not median > 0.0:
        return np.full(image.point.shape, np.nan, np.float32)
    out: F4 = np.minimum(strength / np.float32(median), np.float32(settings.max_intensity))
    return out


def belong_together(
    settings: SegmentationSettings, range_1_m: float, range_2_m: float, step_rad: float, difference: float
) -> bool:
    """Whether two neighbours `step_rad` apart are one segment; `difference` of intensities, NaN when unknown."""
    sine, cosine = float(np.sin(step_rad)), float(np.cos(step_rad))
    return bool(
        _together(float(range_1_m), float(range_2_m), sine, cosine, float(difference), _rule(settings))
    )


def _rule(settings: SegmentationSettings) -> F8:
    """theta, a (rad), b, largest difference, rule; cot(theta), cot(theta - a)."""
    angle, relaxation = np.radians(settings.angle_deg), np.radians(settings.relaxation_deg)
    rule = float(RULES[settings.rule])
    cotangents = 1 / np.tan(angle), 1 / np.tan(max(angle - relaxation, 1e-3))
    return np.array([angle, relaxation, settings.alike, settings.max_difference, rule, *cotangents])


@kernel
def _together(r1: float, r2: float, sine: float, cosine: float, difference: float, rule: F8) -> bool:
    """beta = atan2(d2 sin s, d1 - d2 cos s) > theta, d1 >= d2, which is d1 - d2 cos s < d2 sin s cot(theta).

    theta less the relaxation where intensities are alike.
    """
    if difference > rule[3]:
        return False
    far, near = max(r1, r2), min(r1, r2)
    off, across = far - near * cosine, near * sine
    if off < across * rule[5]:
        return True
    if not difference < rule[2] or rule[4] == 0.0 or off >= across * rule[6]:
        return False
    share = 1.0 if rule[4] == 1.0 else 1.0 - difference / rule[2]
    return bool(off * np.tan(max(rule[0] - rule[1] * share, 1e-3)) < across)


@kernel
def _neighbour(point: I4, row: Int, column: Int, up: Int, right: Int, gap: Int) -> tuple[Int, Int, Int]:
    """The next filled cell in a direction and its distance in cells, at most `gap` + 1; distance 0 when there is none."""
    rows, columns = point.shape
    v, u = row, column
    for k in range(1, gap + 2):
        v += up
        u += right
        if u < 0:
            u += columns
        elif u >= columns:
            u -= columns
        if v < 0 or v >= rows:
            return 0, 0, 0
        if point[v, u] >= 0:
            return v, u, k
    return 0, 0, 0


@kernel
def _label(
    point: I4, ranges: F4, brightness: F4, elevation: F8, column_step: float, rule: F8, gap: int, label: I4
) -> I8:  # fmt: skip
    """Labels in place from 1; returns points and rows (segments, 2) of each."""
    rows, columns = point.shape
    sines, cosines = _row_steps(elevation, gap + 1)
    queue = np.empty(rows * columns, np.int64)
    sizes = np.zeros((rows * columns // 2 + 2, 2), np.int64)
    found: Int = 0
    row_of = np.full(rows, -1, np.int64)
    for start in range(rows * columns):
        if point[start // columns, start % columns] < 0 or label[start // columns, start % columns] > 0:
            continue
        found += 1
        if found > len(sizes):
            sizes = np.concatenate((sizes, np.zeros_like(sizes)))
        queue[0] = start
        label[start // columns, start % columns] = found
        head: Int = 0
        tail: Int = 1
        while head < tail:
            v, u = queue[head] // columns, queue[head] % columns
            head += 1
            sizes[found - 1, 0] += 1
            if row_of[v] != found:
                row_of[v] = found
                sizes[found - 1, 1] += 1
            for side in range(4):
                up, right = (1 - side, 0) if side % 2 == 0 else (0, 2 - side)
                w, t, cells = _neighbour(point, v, u, up, right, gap)
                if cells == 0 or label[w, t] > 0:
                    continue
                sine, cosine = sines[v, w - v + gap + 1], cosines[v, w - v + gap + 1]
                if up == 0:
                    sine, cosine = np.sin(cells * column_step), np.cos(cells * column_step)
                difference = abs(brightness[v, u] - brightness[w, t])
                if _together(ranges[v, u], ranges[w, t], sine, cosine, difference, rule):
                    label[w, t] = found
                    queue[tail] = w * columns + t
                    tail += 1
    return sizes[:found].copy()


@kernel
def _row_steps(elevation: F8, most: int) -> tuple[F8, F8]:
    """Sine and cosine (rows, 2 most + 1) of the angles to the rows up to `most` below and above."""
    rows = len(elevation)
    sines, cosines = np.zeros((rows, 2 * most + 1)), np.ones((rows, 2 * most + 1))
    for v in range(rows):
        for k in range(-most, most + 1):
            if 0 <= v + k < rows:
                step = abs(elevation[v + k] - elevation[v])
                sines[v, k + most], cosines[v, k + most] = np.sin(step), np.cos(step)
    return sines, cosines


@kernel
def _strength(point: I4, ranges: F4, xyz: F4, intensity: F4, reference: float, power: float) -> F4:
    """I (r / r_ref)^p / cos(incidence) per cell; NaN where there is no point or no intensity."""
    rows, columns = point.shape
    out = np.full((rows, columns), np.nan, np.float32)
    beside, above = np.empty(3), np.empty(3)
    for v in range(rows):
        for u in range(columns):
            n = point[v, u]
            if n < 0 or not intensity[n] > 0.0:
                continue
            side = _tangent(point, ranges, xyz, v, u, 0, 1, beside)
            tall = _tangent(point, ranges, xyz, v, u, 1, 0, above)
            cosine = _cosine(xyz[n], ranges[v, u], beside, above, side, tall)
            ratio = ranges[v, u] / reference
            spread = ratio * ratio if power == 2.0 else ratio**power
            out[v, u] = intensity[n] * spread / max(cosine, LEAST_COSINE)
    return out


@kernel
def _tangent(point: I4, ranges: F4, xyz: F4, v: Int, u: Int, up: int, right: int, out: F8) -> bool:
    """Vector to the neighbour of most alike range on either side; False when there is none."""
    best = np.inf
    for sign in (-1, 1):
        w, t, cells = _neighbour(point, v, u, sign * up, sign * right, 1)
        if cells > 0 and abs(ranges[w, t] - ranges[v, u]) < best:
            best = abs(ranges[w, t] - ranges[v, u])
            for k in range(3):
                out[k] = xyz[point[w, t], k] - xyz[point[v, u], k]
    return best < np.inf


@kernel
def _cosine(p: F4, r: float, beside: F8, above: F8, side: bool, tall: bool) -> float:
    """Cosine of incidence on the plane of the two tangents; of one, on the plane that is square to beam and tangent."""
    if side and tall:
        nx = beside[1] * above[2] - beside[2] * above[1]
        ny = beside[2] * above[0] - beside[0] * above[2]
        nz = beside[0] * above[1] - beside[1] * above[0]
        length = np.sqrt(nx * nx + ny * ny + nz * nz) * r
        return float(abs(nx * p[0] + ny * p[1] + nz * p[2]) / length) if length > 0.0 else 1.0
    if not side and not tall:
        return 1.0
    t = beside if side else above
    length = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]) * r
    along = abs(t[0] * p[0] + t[1] * p[1] + t[2] * p[2]) / length if length > 0.0 else 0.0
    return float(np.sqrt(max(1.0 - along * along, 0.0)))
