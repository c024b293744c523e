"""What a cleaned map is good for: how crisp it is, and whether scans still find their place in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.clean_nearness import F4, Mask
from benchmarks.clean_scenes import Scene
from benchmarks.scores import Score
from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.entropy import mean_entropy, point_entropies
from scanloom.stages.geometry.registration import SurfelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log
from scanloom.stages.geometry.voxels import downsample

ENTROPY_RADIUS_M, ENTROPY_NEIGHBOURS, ENTROPY_SAMPLES = 0.3, 10, 50_000
EVERY = 20
"""One scan in so many is held back from the map and looked for in it."""
OFFSET_M, OFFSET_DEG = 0.5, 5.0
DIRECTIONS = 4
NEAR_M, NEAR_DEG = 0.1, 0.5
MAP_SPACING_M, SCAN_SPACING_M = 0.4, 0.5
"""Of points. With a scan thinned to 1 m the localiser was lost now and then in maps of all points as in clean ones: which of
them was a matter of chance."""
VOXELS_M, SCALES_M = (3.0, 1.0), (1.0, 0.15)
"""Edge of a voxel, which is also the reach of the search, and scale of the robust kernel: first the rough place, then the fine
one. Five degrees are 2.6 m at a range of 30 m."""


def entropy(placed: F4, kept: Mask, judged: Mask) -> tuple[float, float]:
    """Mean map entropy, nat, of everything and of what is kept, at the same seeded sample of points that are `judged`.

    Places count where both clouds have enough neighbours.
    """
    rng = np.random.default_rng(0)
    candidates = np.flatnonzero(judged & kept)
    places = np.sort(rng.choice(candidates, min(ENTROPY_SAMPLES, len(candidates)), replace=False))
    row = np.cumsum(kept) - 1
    radii = (ENTROPY_RADIUS_M,)
    before = point_entropies(placed, places, radii, ENTROPY_NEIGHBOURS)
    after = point_entropies(placed[kept], row[places], radii, ENTROPY_NEIGHBOURS)
    both = np.isfinite(before) & np.isfinite(after)
    means = [mean_entropy(np.where(both, found, np.nan))[0][0] for found in (before, after)]
    return float(means[0]), float(means[1])


def entropy_scores(placed: F4, kept: Mask, judged: Mask) -> Iterator[Score]:
    """Mean map entropy before and after cleaning."""
    how = f"mean map entropy within {ENTROPY_RADIUS_M:g} m at the same {ENTROPY_SAMPLES} kept points, "
    before, after = entropy(placed, kept, judged)
    yield Score("mme_before", before, "nat", f"{how}in the cloud of all points")
    yield Score("mme_after", after, "nat", f"{how}in the cleaned cloud")


def localisation(scene: Scene, poses: str, kept: Mask) -> Mask:
    """Which scans, put off their place by 0.5 m and 5 degrees in four directions each, find it again in the map of `kept`.

    The scans looked for are no part of the map; they are registered as denoise leaves them.
    """
    T = scene.poses[poses]
    targets = [SurfelMap(voxel_m) for voxel_m in VOXELS_M]
    for k in range(len(scene)):
        if k % EVERY != EVERY // 2:
            rows = scene.scan(k)
            points = scene.points[rows][kept[rows]].astype(np.float64)
            few = points[downsample(points, MAP_SPACING_M)]
            for target in targets:
                target.insert(few, np.ascontiguousarray(T[k]))
    home = [
        _comes_home(targets, _looked_for(scene, k), T[k] @ offset, T[k])
        for k in range(EVERY // 2, len(scene), EVERY)
        for offset in _offsets()
    ]
    return np.array(home, np.bool_)


def _looked_for(scene: Scene, index: int) -> F8:
    rows = scene.scan(index)
    scenery = np.isin(scene.labels[rows], (PointClass.STATIC, PointClass.GROUND))
    points = scene.points[rows][scenery].astype(np.float64)
    return points[downsample(points, SCAN_SPACING_M)]


def _offsets() -> Iterator[F8]:
    """Displacements (4, 4) to four sides, turned left and right in turn."""
    for k in range(DIRECTIONS):
        heading = 2 * np.pi * (k + 0.5) / DIRECTIONS
        turn = np.radians(OFFSET_DEG) * (1 if k % 2 else -1)
        aside = OFFSET_M * np.array([np.cos(heading), np.sin(heading), 0.0])
        T = se3_exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]))
        T[:3, 3] = aside
        yield T


def _comes_home(targets: Sequence[SurfelMap], points: F8, start: F8, true: F8) -> bool:
    T = np.ascontiguousarray(start)
    for target, scale in zip(targets, SCALES_M, strict=True):
        reach_m = target.voxel_size_m
        T = align(target, points, T, max_distance_m=reach_m, scale_m=scale, max_iterations=40).T_target_source
    error = se3_log(inverse(true) @ T)
    return bool(np.linalg.norm(error[3:]) <= NEAR_M and np.degrees(np.linalg.norm(error[:3])) <= NEAR_DEG)


def localisation_scores(before: Mask, after: Mask) -> Iterator[Score]:
    """Shares that come home in the map of everything and in the cleaned one, and what cleaning made fail."""
    how = (
        f"{len(after)} registrations of held-back scans, {OFFSET_M:g} m and {OFFSET_DEG:g} degrees off, "
        f"that end within {NEAR_M:g} m and {NEAR_DEG:g} degrees"
    )
    yield Score("localisation_before_percent", 100.0 * float(before.mean()), "%", f"{how}; map of all points")
    yield Score("localisation_after_percent", 100.0 * float(after.mean()), "%", f"{how}; cleaned map")
    yield Score(
        "localisation_failures", int((before & ~after).sum()), "", "that came home before cleaning, not after"
    )
