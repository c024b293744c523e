"""The map from above: points splatted into pixels, coloured by height, intensity, class or what cameras saw, shaded by
depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.scans import PointClass
from scanloom.schemas.tiles import Tile
from scanloom.stages.geometry.kernels import kernel

BACKGROUND = (13, 17, 23)
_GROUND_CELL_M = 4.0
_TALL_M = 9.0
_GROUND_M = 0.4
_RAMP = np.array(
    [[62, 74, 102], [38, 112, 142], [42, 160, 134], [126, 196, 92], [236, 214, 96], [250, 236, 190]], float
)
"""Colours from the ground up to `_TALL_M`."""
_GREYS = np.array([[30, 34, 42], [128, 132, 138], [250, 250, 246]], float)
_GAMMA = 0.65
"""Below one lifts the dark ground, of which most of a map is."""
CLASS_COLOURS = {PointClass.GROUND: (138, 122, 100), PointClass.STATIC: (92, 164, 208)}
_UNSEEN = (44, 48, 54)
"""Of what no camera saw."""
_OTHER_COLOUR = (200, 120, 200)
"""Of classes that a map does not usually hold."""


@dataclass(frozen=True)
class View:
    """A north-up window on the map: lower left corner, size in pixels, metres per pixel."""

    left_m: float
    bottom_m: float
    width: int
    height: int
    pixel_m: float

    def pixels(self, xy_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image coordinates (n, 2), x right and y down, of map coordinates (n, 2), m."""
        x = (xy_m[:, 0] - self.left_m) / self.pixel_m
        y = self.height - (xy_m[:, 1] - self.bottom_m) / self.pixel_m
        return np.column_stack((x, y))

    def enlarged(self, factor: int) -> View:
        """The same window with more pixels."""
        return View(
            self.left_m, self.bottom_m, self.width * factor, self.height * factor, self.pixel_m / factor
        )


def fit_view(low_m: Any, high_m: Any, margin_m: float, longest: int, finest_m: float) -> View:
    """The view that shows a rectangle with a margin, `longest` pixels at most, `finest_m` per pixel at least."""
    low, high = np.asarray(low_m, float) - margin_m, np.asarray(high_m, float) + margin_m
    span = np.maximum(high - low, 1.0)
    low = (low + high - span) / 2
    # No narrower than 2 to 5, so that a straight drive is no thin strip.
    wide = np.maximum(span, span.max() * 0.4)
    low -= (wide - span) / 2
    pixel_m = max(float(wide.max()) / longest, finest_m)
    width, height = np.maximum(np.ceil(wide / pixel_m).astype(int), 16)
    return View(float(low[0]), float(low[1]), int(width), int(height), pixel_m)


@dataclass(frozen=True)
class Drawn:
    """The same view three times, RGB (height, width, 3), and once more where cameras saw the map."""

    height: NDArray[np.uint8]
    intensity: NDArray[np.uint8]
    classes: NDArray[np.uint8]
    colour: NDArray[np.uint8] | None = None


def draw_map(tiles: Iterable[Tile], view: View) -> Drawn:
    """Images of the tiles, which are read one by one and once."""
    shape = (view.height, view.width)
    top = np.full(shape, -np.inf, np.float32)
    bright, glow = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    kind = np.zeros(shape, np.uint8)
    cell = max(_GROUND_CELL_M, view.pixel_m)
    step = max(round(cell / view.pixel_m), 1)
    cells = (view.height // step + 1, view.width // step + 1)
    low, soil = np.full(cells, np.inf, np.float32), np.zeros((*cells, 2))
    seen, tint = np.full(shape, -np.inf, np.float32), np.zeros((*shape, 3), np.uint8)
    for tile in tiles:
        left, bottom = tile.offset_m[0] - view.left_m, tile.offset_m[1] - view.bottom_m
        _splat(
            tile.x_m, tile.y_m, tile.z_m, tile.offset_m[2], tile.intensity, tile.class_, int(PointClass.GROUND),
            left, bottom, view.pixel_m, step, top, bright, glow, kind, low, soil,
        )  # fmt: skip
        _splat_colour(
            tile.x_m,
            tile.y_m,
            tile.z_m,
            tile.offset_m[2],
            tile.colour,
            tile.views,
            left,
            bottom,
            view.pixel_m,
            seen,
            tint,
        )
    filled = np.isfinite(top)
    if not filled.any():
        return Drawn(*(np.full((*shape, 3), BACKGROUND, np.uint8) for _ in range(3)))
    _close_gaps(top, bright, glow, kind)
    filled = np.isfinite(top)
    above = np.where(filled, top - _ground(low, soil, step, shape), 0.0).astype(np.float32)
    light = _depth_light(top, view.pixel_m)
    return Drawn(
        _shade(top, above, _stretch(bright, filled), light),
        _in_greys(np.where((above < _GROUND_M) & (bright > 0), bright, glow), filled, light),
        _in_classes(kind, filled, light),
        _in_colour(seen, tint, filled, light),
    )


def _in_greys(
    glow: NDArray[np.float32], filled: NDArray[np.bool_], light: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Intensity: that of the ground where it lies open, else of the highest point."""
    place = _stretch(glow, filled) ** _GAMMA * (len(_GREYS) - 1)
    i = np.minimum(place.astype(np.int64), len(_GREYS) - 2)
    share = (place - i)[..., None]
    colour = (_GREYS[i] * (1.0 - share) + _GREYS[i + 1] * share) * (0.4 + 0.6 * light)[..., None]
    return np.where(filled[..., None], colour, np.array(BACKGROUND)).astype(np.uint8)


def _in_classes(
    kind: NDArray[np.uint8], filled: NDArray[np.bool_], light: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Class of the highest point."""
    colours = np.tile(np.array(_OTHER_COLOUR, float), (256, 1))
    for class_, colour in CLASS_COLOURS.items():
        colours[int(class_)] = colour
    shaded = colours[kind] * light[..., None]
    return np.where(filled[..., None], shaded, np.array(BACKGROUND)).astype(np.uint8)


def _in_colour(
    seen: NDArray[np.float32],
    tint: NDArray[np.uint8],
    filled: NDArray[np.bool_],
    light: NDArray[np.float32],
) -> NDArray[np.uint8] | None:
    """What cameras saw, dark grey where they saw nothing; None where they saw nothing at all."""
    known = np.isfinite(seen)
    if not known.any():
        return None
    colour = np.where(known[..., None], tint, np.array(_UNSEEN)) * (0.5 + 0.5 * light)[..., None]
    return np.where((filled | known)[..., None], colour, np.array(BACKGROUND)).astype(np.uint8)


def _ground(
    low: NDArray[np.float32], soil: NDArray[np.float64], step: int, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Height of the ground per pixel: mean of the ground points of coarse cells, filled in and smoothed.

    A map without ground points falls back on the lowest point of each cell.
    """
    from scipy import ndimage

    counted = soil[..., 1] > 0
    height = soil[..., 0] / np.maximum(soil[..., 1], 1) if counted.any() else low
    known = counted if counted.any() else np.isfinite(low)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    smooth = ndimage.gaussian_filter(ndimage.median_filter(height[tuple(nearest)], 3), 1.0)
    fine = np.repeat(np.repeat(smooth, step, axis=0), step, axis=1)[: shape[0], : shape[1]]
    ground: NDArray[np.float32] = ndimage.uniform_filter(fine, step).astype(np.float32)
    return ground


def _stretch(bright: NDArray[np.float32], filled: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Intensity of ground spread over 0 to 1 between its 5th and 98th percentile."""
    values = bright[filled & (bright > 0)][::7]
    if len(values) < 100:
        return np.full_like(bright, 0.4)
    low, high = np.percentile(values, (5, 98))
    out: NDArray[np.float32] = np.clip((bright - low) / max(high - low, 1e-6), 0, 1).astype(np.float32)
    return out


def _shade(
    top: NDArray[np.float32],
    above: NDArray[np.float32],
    bright: NDArray[np.float32],
    light: NDArray[np.float32],
) -> NDArray[np.uint8]:
    image = np.empty((*top.shape, 3), np.uint8)
    image[:] = BACKGROUND
    _colour(top, above, bright, light, _RAMP, image)
    return image


@kernel
def _colour(
    top: NDArray[np.float32], above: NDArray[np.float32], bright: NDArray[np.float32], light: NDArray[np.float32],
    ramp: NDArray[np.float64], image: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Colour of every filled pixel by its height above ground; ground is as bright as it reflects."""
    for y in range(top.shape[0]):
        for x in range(top.shape[1]):
            if not np.isfinite(top[y, x]):
                continue
            place = min(max(above[y, x] / _TALL_M, 0.0), 1.0) * (len(ramp) - 1)
            i = min(int(place), len(ramp) - 2)
            share = place - i
            strength = light[y, x] * (0.65 + bright[y, x] if above[y, x] < _GROUND_M else 1.0)
            for c in range(3):
                value = (ramp[i, c] * (1.0 - share) + ramp[i + 1, c] * share) * strength
                image[y, x, c] = np.uint8(min(max(value, 0.0), 255.0))


@kernel
def _splat(
    xs: NDArray[np.float32], ys: NDArray[np.float32], zs: NDArray[np.float32], z0: float,
    intensity: NDArray[np.float32], classes: NDArray[np.uint8], ground: int, left: float, bottom: float,
    pixel_m: float, step: int, top: NDArray[np.float32], bright: NDArray[np.float32], glow: NDArray[np.float32],
    kind: NDArray[np.uint8], low: NDArray[np.float32], soil: NDArray[np.float64],
) -> None:  # fmt: skip
    """Keep per pixel the highest point with its intensity and class, and the brightest ground; per coarse cell the lowest
    point and the sum of ground heights."""
    height, width = top.shape
    for i in range(len(xs)):
        px = np.int64(np.floor((xs[i] + left) / pixel_m))
        py = height - 1 - np.int64(np.floor((ys[i] + bottom) / pixel_m))
        if px < 0 or px >= width or py < 0 or py >= height:
            continue
        z = zs[i] + z0
        if z > top[py, px]:
            top[py, px], glow[py, px], kind[py, px] = z, intensity[i], classes[i]
        if classes[i] == ground:
            bright[py, px] = max(bright[py, px], intensity[i])
            soil[py // step, px // step, 0] += z
            soil[py // step, px // step, 1] += 1.0
        if z < low[py // step, px // step]:
            low[py // step, px // step] = z


@kernel
def _splat_colour(
    xs: NDArray[np.float32], ys: NDArray[np.float32], zs: NDArray[np.float32], z0: float, colour: NDArray[np.uint8],
    views: NDArray[np.uint16], left: float, bottom: float, pixel_m: float, seen: NDArray[np.float32],
    tint: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Keep per pixel the highest point that has a colour: cameras on the road see few roofs."""
    height, width = seen.shape
    for i in range(len(xs)):
        px = np.int64(np.floor((xs[i] + left) / pixel_m))
        py = height - 1 - np.int64(np.floor((ys[i] + bottom) / pixel_m))
        if views[i] == 0 or px < 0 or px >= width or py < 0 or py >= height:
            continue
        z = zs[i] + z0
        if z > seen[py, px]:
            seen[py, px] = z
            for c in range(3):
                tint[py, px, c] = colour[i, c]


@kernel
def _close_gaps(
    top: NDArray[np.float32], bright: NDArray[np.float32], glow: NDArray[np.float32], kind: NDArray[np.uint8]
) -> None:
    """Fill empty pixels that have three filled neighbours or more with their mean, in place, in one pass."""
    height, width = top.shape
    filled = np.isfinite(top)
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            if filled[y, x]:
                continue
            count, z, b, g = 0, 0.0, 0.0, 0.0
            class_ = np.uint8(0)
            for ny in range(y - 1, y + 2):
                for nx in range(x - 1, x + 2):
                    if filled[ny, nx]:
                        count, z, b, g = count + 1, z + top[ny, nx], b + bright[ny, nx], g + glow[ny, nx]
                        class_ = kind[ny, nx]
            if count >= 3:
                top[y, x], bright[y, x], glow[y, x], kind[y, x] = z / count, b / count, g / count, class_


@kernel
def _depth_light(top: NDArray[np.float32], pixel_m: float) -> NDArray[np.float32]:
    """Eye-dome lighting (Boucheny 2009): a pixel is darker the more its neighbours stand above it."""
    height, width = top.shape
    light = np.ones((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            if not np.isfinite(top[y, x]):
                continue
            shadow = 0.0
            for reach in (1, 2):
                for k in range(4):
                    ny = y + (reach if k == 0 else (-reach if k == 1 else 0))
                    nx = x + (reach if k == 2 else (-reach if k == 3 else 0))
                    if 0 <= ny < height and 0 <= nx < width and np.isfinite(top[ny, nx]):
                        rise = (top[ny, nx] - top[y, x]) / (reach * max(pixel_m, 0.2))
                        shadow += min(max(rise, 0.0), 4.0)
            light[y, x] = np.exp(-0.075 * shadow)
    return light
