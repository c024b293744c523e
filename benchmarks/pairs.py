"""Does E tell matching from non-matching pairs of places better than D does (methods 1.7 and 1.14).

A pair is a scan and a submap. Matching: the scan was taken 1 to 8 m from the submap's middle. Non-matching: it was taken
elsewhere, at least 25 m away, but is registered as if it belonged. Both start from a pose with the noise of level L1 (0.5 m;
3, 1.5, 1.5 deg); for non-matching pairs it is that of a matching pair. Each indicator sees the registration alone. Its AUC is
the chance that it calls a random non-matching pair worse than a random matching one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.comparison import Runner
from benchmarks.scores import Score, interpolated
from benchmarks.sequences import Recording
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels, PointClass
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.degeneracy import Degeneracy, judge
from scanloom.stages.geometry.registration import Registration, VoxelMap, align
from scanloom.stages.geometry.se3 import F8, inverse, pose, so3_exp, transform
from scanloom.stages.geometry.voxels import downsample

SHARES = {"town_32": 0.25, "town_16": 0.15, "town_64": 0.15, "tunnel": 0.1, "field": 0.1}
"""Of all pairs, by simulated sequence; the rest comes from real scans."""
NEAR_M, FAR_M, ELSEWHERE_M = 1.0, 8.0, 25.0
SUBMAP_SCANS, SUBMAP_STEP = 5, 2
NOISE_M, NOISE_RAD = np.array([0.5, 0.5, 0.5]), np.radians([1.5, 1.5, 3.0])
USED = (PointClass.UNLABELLED, PointClass.GROUND, PointClass.STATIC)
FINE_M, COARSE_M = 0.25, 0.8
STAGES = ((1.5, 1.0), (0.8, 0.4))
"""Registration from coarse to fine: voxel of the map and scale of the robust kernel, m."""
RIGHT_M, RIGHT_RAD = 0.5, np.radians(2.0)
SUBMAPS = 25
"""Submaps per recording; each takes part in many pairs."""

INDICATORS: Mapping[str, Callable[[Registration, Degeneracy], float]] = {
    "d": lambda registration, seen: -seen.d,
    "d_unscaled": lambda registration, seen: -seen.d * float(registration.weights.sum()),
    "e1": lambda registration, seen: seen.e_m,
    "e2": lambda registration, seen: _over(registration.rmse_m, registration.inlier_ratio),
    "e3": lambda registration, seen: _over(seen.e_m, registration.inlier_ratio),
    "rmse": lambda registration, seen: _over(registration.rmse_m, 1.0),
    "inlier_ratio": lambda registration, seen: -registration.inlier_ratio,
    "least_p": lambda registration, seen: -float(seen.p.min()),
}
"""The larger, the worse."""


@dataclass(frozen=True)
class Places:
    """Static points of the scans of a recording, thinned, and their true poses."""

    fine: Sequence[F8]
    coarse: Sequence[F8]
    T: F8

    @classmethod
    def of(cls, recording: Recording, truth: Truth, every: int = 2) -> Places:
        """Every second scan that truth covers."""
        fine, coarse, stamps = [], [], []
        deskewed, labels = recording.parts(Deskewed), recording.parts(Labels)
        for k, (scan, label) in enumerate(zip(_flat(deskewed), _flat(labels), strict=True)):
            if k % every:
                continue
            points = scan.points()[np.isin(label.class_, USED)].astype(np.float64)
            fine.append(points[downsample(points, FINE_M)])
            coarse.append(points[downsample(points, COARSE_M)])
            stamps.append(scan.reference_ns)
        T, covered = interpolated(truth, np.array(stamps, np.int64))
        kept = np.flatnonzero(covered)
        return cls([fine[k] for k in kept], [coarse[k] for k in kept], T)

    def submap(self, i: int, voxel_m: float) -> VoxelMap:
        """Scans around scan i, in its frame."""
        around = VoxelMap(voxel_m)
        half = SUBMAP_SCANS // 2 * SUBMAP_STEP
        for k in range(max(i - half, 0), min(i + half + 1, len(self.T)), SUBMAP_STEP):
            around.insert(transform(inverse(self.T[i]) @ self.T[k], self.fine[k]))
        return around


@dataclass(frozen=True)
class Judged:
    """One pair: what each indicator says, and how far the registration ended from the truth."""

    matching: bool
    values: Mapping[str, float]
    right: bool


def judged_pairs(places: Places, count: int, seed: int) -> Iterator[Judged]:
    """`count` matching and `count` non-matching pairs of one recording; fewer where it is too short for them."""
    rng = np.random.default_rng(seed)
    position = places.T[:, :3, 3]
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    middles = np.linspace(0, len(position) - 1, min(SUBMAPS, len(position))).astype(int)
    usable = [i for i in middles if _choices(apart[i])[0].size and _choices(apart[i])[1].size]
    for n, i in enumerate(usable):
        share = count // len(usable) + (n < count % len(usable))
        maps = [(places.submap(i, voxel_m), scale_m) for voxel_m, scale_m in STAGES]
        near, far = _choices(apart[i])
        for _ in range(share):
            j = int(rng.choice(near))
            true = inverse(places.T[i]) @ places.T[j]
            start = true @ _noise(rng)
            yield _judge(maps, places.coarse[j], start, true)
            yield _judge(maps, places.coarse[int(rng.choice(far))], start, None)


def _choices(apart: F8) -> tuple[np.ndarray, np.ndarray]:
    return np.flatnonzero((apart > NEAR_M) & (apart < FAR_M)), np.flatnonzero(apart > ELSEWHERE_M)


def _noise(rng: np.random.Generator) -> F8:
    return pose(so3_exp(NOISE_RAD * rng.standard_normal(3)), NOISE_M * rng.standard_normal(3))


def _judge(maps: Sequence[tuple[VoxelMap, float]], points: F8, start: F8, true: F8 | None) -> Judged:
    T = start
    for around, scale_m in maps:
        registration = align(around, points, T, max_distance_m=around.voxel_size_m, scale_m=scale_m)
        T = registration.T_target_source
    seen = judge(registration)
    off = np.eye(4) if true is None else inverse(true) @ T
    turned = np.arccos(np.clip((np.trace(off[:3, :3]) - 1) / 2, -1, 1))
    right = true is not None and bool(np.linalg.norm(off[:3, 3]) < RIGHT_M and turned < RIGHT_RAD)
    return Judged(
        true is not None, {name: say(registration, seen) for name, say in INDICATORS.items()}, right
    )


def judge_all(runner: Runner, recordings: Sequence[Recording], count: int) -> dict[str, list[Judged]]:
    """`count` pairs of each kind, from simulated and real scans; the real ones make up for what is left."""
    simulated = [r for r in recordings if r.name in SHARES]
    real = [r for r in recordings if not r.simulated]
    wanted = {r.name: round(SHARES[r.name] * count) for r in simulated}
    left = count - sum(wanted.values())
    wanted |= {r.name: left // len(real) for r in real}
    found = {}
    for k, recording in enumerate([*simulated, *real]):
        places = Places.of(recording, runner.truth(recording)[0])
        found[recording.name] = list(judged_pairs(places, wanted[recording.name], seed=k))
    return found


def auc(worse: F8, better: F8) -> float:
    """Chance that a value of `worse` exceeds one of `better`, ties count half (Mann-Whitney)."""
    from scipy.stats import rankdata

    ranks = rankdata(np.concatenate((worse, better)))[: len(worse)]
    return float((ranks.sum() - len(worse) * (len(worse) + 1) / 2) / (len(worse) * len(better)))


def scores(sets: Mapping[str, Sequence[Judged]]) -> Iterator[Score]:
    """AUC of every indicator over all pairs, and by recording."""
    everything = [pair for pairs in sets.values() for pair in pairs]
    matching = [pair for pair in everything if pair.matching]
    yield Score("matching", len(matching), "", "pairs of a scan and a submap of the same place")
    yield Score("non_matching", len(everything) - len(matching), "", "pairs of different places")
    yield Score(
        "registered_right", float(np.mean([pair.right for pair in matching])), "",
        f"share of matching pairs registered within {RIGHT_M:g} m and 2 deg of truth",
    )  # fmt: skip
    for name in INDICATORS:
        yield Score(f"auc_{name}", _auc(everything, name), "", f"{_MEANING[name]}; all pairs")
    for sequence, pairs in sets.items():
        for name in ("d", "e1"):
            yield Score(
                f"{sequence}.auc_{name}", _auc(pairs, name), "", f"{_MEANING[name]}; {len(pairs)} pairs"
            )


_MEANING = {
    "d": "D inverted, per unit weight", "d_unscaled": "D inverted, not per unit weight", "e1": "E1",
    "e2": "E2: rmse over inlier ratio", "e3": "E3: E1 over inlier ratio", "rmse": "rmse of the inliers",
    "inlier_ratio": "inlier ratio inverted", "least_p": "smallest p of DRPM inverted",
}  # fmt: skip


def _auc(pairs: Sequence[Judged], name: str) -> float:
    values = np.nan_to_num(np.array([pair.values[name] for pair in pairs]), nan=np.inf, posinf=1e9)
    matching = np.array([pair.matching for pair in pairs])
    return auc(values[~matching], values[matching])


def _over(value: float, share: float) -> float:
    return value / share if share > 0 and np.isfinite(value) else 1e9


def _flat(parts: Parts) -> Iterator:
    return (item for part in parts for item in part)
