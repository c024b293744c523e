"""The map itself, without any truth: how large it is, how crisp, how dense, and how much of it was met again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Parts
from scanloom.schemas.tiles import RemovedTile, Tile
from scanloom.schemas.trajectory import Poses
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.layers import GAP, RADIUS_M, THICKNESS, Patch
from scanloom.stages.evaluation.passes import LONGER_M, TIMES_AS_LONG, Passes
from scanloom.stages.evaluation.survey import Manner, Survey, survey
from scanloom.stages.geometry.entropy import mean_entropy
from scanloom.stages.geometry.se3 import F8

Figures = Iterator[Figure]


def map_figures(
    tiles: Parts[Tile], removed: Parts[RemovedTile] | None, poses: Mapping[str, Poses], manner: Manner
) -> Figures:
    """Everything that the tiles tell; they are read once, one by one."""
    passes = Passes(poses)
    surveys = [survey(tile, out, passes, manner) for tile, out in _pairs(tiles, removed)]
    points = sum(s.points for s in surveys)
    yield Figure("map.tiles", len(surveys), "", "tiles of the map", "map")
    yield Figure("map.points", points, "", "points of all tiles", "map")
    if not points:
        return
    area = sum(s.squares for s in surveys)
    yield Figure("map.area_m2", area, "m2", "squares of 1 m that hold a point, seen from above", "map")
    returns = sum(s.returns for s in surveys)
    yield Figure(
        "map.returns_per_point", returns / points, "", "measured points per point of the map", "map", samples=points
    )  # fmt: skip
    yield from _entropy_figures(surveys, manner)
    yield from _plane_figures(surveys, manner)
    yield from _wall_figures(surveys, manner)
    yield from _overlap_figures(surveys, passes, points, area)
    yield from _density_figures(surveys, manner)


def _pairs(
    tiles: Parts[Tile], removed: Parts[RemovedTile] | None
) -> Iterable[tuple[Tile, RemovedTile | None]]:
    if removed is None:
        return ((tile, None) for tile in tiles)
    return zip(tiles, removed, strict=True)


def _sampled(manner: Manner) -> str:
    return f"at points sampled evenly, at most {manner.samples} a tile"


def _entropy_figures(surveys: Sequence[Survey], manner: Manner) -> Figures:
    entropy, weight = _joined(s.entropy for s in surveys), _joined(s.weight for s in surveys)
    mean, share = mean_entropy(entropy, weight)
    for radius, m, s in zip(manner.radii_m, mean, share):
        how = (
            f"mean of 1/2 ln det(2 pi e Sigma) {_sampled(manner)}; Sigma of the neighbours within {radius} m in the same "
            f"tile, at least {manner.least}"
        )
        yield Figure(f"map.mme_r{radius}_nat", float(m), "nat", how, "map", samples=len(entropy))
        enough = "share of the points with enough neighbours"
        yield Figure(f"map.mme_r{radius}_share", float(s), "", enough, "map", samples=len(entropy))
    yield from _cleaning_figures(surveys, entropy, weight, manner)


def _cleaning_figures(surveys: Sequence[Survey], entropy: F8, weight: F8, manner: Manner) -> Figures:
    """Entropy at the same points of the map, with what was left out around them and without."""
    both = np.column_stack((_joined(s.blurred for s in surveys), entropy[:, len(manner.radii_m) // 2]))
    usable = np.isfinite(both).all(axis=1)
    if not usable.any():
        return
    mean, _ = mean_entropy(both[usable], weight[usable])
    radius = manner.radii_m[len(manner.radii_m) // 2]
    for name, value in zip(("with_removed", "without_removed"), mean):
        how = f"mean map entropy within {radius} m at the points of the map that have it both ways"
        yield Figure(f"clean.mme_{name}_nat", float(value), "nat", how, "map", samples=int(usable.sum()))


def _plane_figures(surveys: Sequence[Survey], manner: Manner) -> Figures:
    variance, weight = _joined(s.variance for s in surveys), _joined(s.weight for s in surveys)
    known = np.isfinite(variance)
    if not known.any():
        return
    variance, weight = variance[known], weight[known]
    radius = manner.radii_m[len(manner.radii_m) // 2]
    how = f"least eigenvalue of the covariance of the neighbours within {radius} m, {_sampled(manner)}"
    mean = float(np.average(variance, weights=weight))
    yield Figure(f"map.mpv_r{radius}_m2", mean, "m2", f"mean {how}", "map", samples=len(variance))
    middle = float(np.sqrt(max(quantile(variance, weight, 0.5), 0.0)))
    root = f"square root of the median {how}"
    yield Figure("map.plane_sigma_median_m", middle, "m", root, "map", samples=len(variance))


def _wall_figures(surveys: Sequence[Survey], manner: Manner) -> Figures:
    kind, weight = _joined(s.patch for s in surveys), _joined(s.patch_weight for s in surveys)
    measured, judged = _joined(s.measured for s in surveys), kind != Patch.NONE
    kind, weight, measured = kind[judged], weight[judged], measured[judged]
    n, what = len(kind), f"patches of upright surfaces, {RADIUS_M:g} m around points of them"
    yield Figure("map.wall_patches", n, "", f"{what}, {_sampled(manner)}", "map")
    if not n:
        return
    low, high = manner.gap_m
    slab = f"thinnest slab that holds two thirds of the points of a patch; {what}"
    for name, q in (("median", 0.5), ("p90", 0.9)):
        value = quantile(measured[:, THICKNESS], weight, q)
        yield Figure(
            f"map.wall_thickness_{name}_m",
            value,
            "m",
            f"{100 * q:g} % quantile of the {slab}",
            "map",
            samples=n,
        )
    for name, which, seen in (
        ("double", Patch.DOUBLE, "that were not seen from opposite sides"),
        ("two_sided", Patch.TWO_SIDED, "that were seen from opposite sides, away from each other"),
    ):
        how = f"share of {what} with two layers {low:g} to {high:g} m apart, one behind the other, {seen}"
        share = float(np.average(kind == which, weights=weight))
        yield Figure(f"map.wall_{name}_share", share, "", how, "map", samples=n)
    gap = measured[kind == Patch.DOUBLE, GAP]
    if len(gap):
        how = "median distance of the layers of the double ones among them"
        yield Figure("map.wall_double_gap_median_m", float(np.median(gap)), "m", how, "map", samples=len(gap))


def _overlap_figures(surveys: Sequence[Survey], passes: Passes, points: int, area: int) -> Figures:
    if not passes.known:
        return
    how = (
        f"met again when the way driven from the first to the last time is more than {TIMES_AS_LONG:g} times the distances "
        f"to the vehicle then and {LONGER_M:g} m, or when another session came"
    )
    again, other = sum(s.again for s in surveys), sum(s.other for s in surveys)
    yield Figure("map.overlap_share", again / points, "", f"share of the points {how}", "map", samples=points)
    squares = sum(s.again_squares for s in surveys)
    yield Figure(
        "map.overlap_area_share", squares / area, "", f"share of the squares of 1 m with a point {how}", "map", samples=area
    )  # fmt: skip
    if passes.several:
        yield Figure(
            "map.overlap_sessions_share", other / points, "", "share of the points that two sessions met", "map",
            samples=points,
        )  # fmt: skip


def _density_figures(surveys: Sequence[Survey], manner: Manner) -> Figures:
    squares = _summed(s.ground for s in surveys)
    if squares.any():
        how = "of the points of class ground in squares of 1 m that have any"
        for name, q in (("median", 0.5), ("p10", 0.1)):
            value = float(np.searchsorted(np.cumsum(squares), q * squares.sum()))
            yield Figure(
                f"map.ground_density_{name}", value, "1/m2", f"{100 * q:g} % quantile {how}", "map",
                samples=int(squares.sum()),
            )  # fmt: skip
    density, weight = _joined(s.density for s in surveys), _joined(s.weight for s in surveys)
    flat = np.isfinite(density)
    if not flat.any():
        return
    radius = manner.radii_m[len(manner.radii_m) // 2]
    how = f"points within {radius} m over the area of a disc, where these form a surface; {_sampled(manner)}"
    for name, q in (("p10", 0.1), ("median", 0.5), ("p90", 0.9)):
        value = quantile(density[flat], weight[flat], q)
        yield Figure(
            f"map.surface_density_{name}", value, "1/m2", f"{100 * q:g} % quantile of {how}", "map",
            samples=int(flat.sum()),
        )  # fmt: skip


def quantile(values: F8, weights: F8, q: float) -> float:
    """The value (n > 0) below which a share q of the weights lies, between the values by straight lines."""
    order = np.argsort(values, kind="stable")
    weight = weights[order].astype(float)
    middle = np.cumsum(weight) - 0.5 * weight
    return float(np.interp(q * weight.sum(), middle, values[order].astype(float)))


def _joined(arrays: Iterable[NDArray]) -> F8:
    """The samples of all tiles, in doubles."""
    return np.concatenate([np.asarray(a) for a in arrays]).astype(float)


def _summed(histograms: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Histograms of different lengths added up."""
    found = list(histograms)
    total = np.zeros(max(map(len, found), default=0), np.int64)
    for histogram in found:
        total[: len(histogram)] += histogram
    return total
