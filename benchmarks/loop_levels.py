"""Two stages of matching against either alone, at the five levels of noise of methods 1.14.

    python -m benchmarks.loop_levels                     towns and estates of three seeds
    python -m benchmarks.loop_levels --worlds estates --seeds 0
    python -m benchmarks.loop_levels --levels 5          the highest alone

True pairs: two keyframes of one drive with at least 60 m of path between them, or of two drives on two days (towns, where
that brings in the tunnel and the open field, which no drive of one lap meets twice), drawn from everywhere they meet:
the first uniformly among those that have a partner, the second uniformly among its partners. `any`: less than 10 m apart;
`opposite`: the same, driven in the opposite direction; `little`: 10 to 14 m apart, so that submaps overlap less. Nothing is left out
because it is hard. Other pairs: `far`, anywhere more than 25 m apart; `alike`, more than 25 m apart but on parallel or the same
street and at the same height of it, where an estate repeats itself; `decks`, less than 8 m apart seen from above, one 3 m over the other.
A pair starts from its true pose with the noise of the level; one that does not match, from that of a true pair.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.scores import Figure
from benchmarks.sequences import Drive
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_log, so3_exp
from scanloom.stages.loops.candidates import Candidate, Track
from scanloom.stages.loops.matching import Target, fine, prior_of, proposals, rough
from scanloom.stages.loops.reading import ScanShelf
from scanloom.stages.loops.submaps import Submap, SubmapSettings, SubmapShelf
from scanloom.stages.loops.verification import Drift, VerificationSettings, decide

LEVELS = (
    ((0.5, 0.5, 0.5), (3.0, 1.5, 1.5)),
    ((1.0, 1.0, 0.5), (5.0, 2.5, 2.5)),
    ((2.0, 2.0, 1.0), (5.0, 2.5, 2.5)),
    ((3.0, 3.0, 1.5), (5.0, 2.5, 2.5)),
    ((3.0, 3.0, 1.5), (10.0, 5.0, 5.0)),
)
"""Standard deviations of x, y, z, m, and of yaw, pitch, roll, deg (methods 1.14; the first rotation is the yaw)."""
RIGHT_M, RIGHT_DEG = 0.5, 2.0
"""A pose is correct within these, at every level, for every method."""
PATH_M, NEAR_M, LITTLE_M, FAR_M, OFFSET_M = 60.0, 10.0, 14.0, 25.0, 5.0
NO_ARGUMENT = Drift(1e5)
"""Odometry's drift after so much path is no argument: the noise stands for it."""
ALL_LEVELS = (1, 2, 3, 4, 5)
METHODS = ("icp", "correlative", "two_stage")
COUNTS = {"any": 25, "opposite": 10, "little": 10, "far": 15, "alike": 30, "decks": 10}
"""Pairs of a world, by kind; fewer where there are none."""
TRUE_KINDS = ("any", "opposite", "little")

Mask = NDArray[np.bool_]


class World(Protocol):
    """A drive: its keyframes, their scans and true poses."""

    name: str
    track: Track
    T_true: F8
    shelf: ScanShelf


@dataclass(frozen=True)
class Pair:
    """Two submaps and the true pose of the second LiDAR in the first."""

    kind: str
    second_day: bool
    i: Submap
    j: Submap
    T_i_j: F8

    @property
    def true(self) -> bool:
        return self.kind in TRUE_KINDS


@dataclass(frozen=True)
class Outcome:
    """What became of one pair at one level."""

    level: int
    kind: str
    second_day: bool
    offset_m: float
    correct: dict[str, bool]
    accepted: bool


def figures(
    meetings: Sequence[tuple[World, World]] | None = None, levels: Sequence[int] = ALL_LEVELS
) -> list[Figure]:
    """Shares of correct loops by level and method, and false ones that were accepted. A meeting: one drive twice, or two."""
    chosen = _meetings() if meetings is None else meetings
    found = [outcome for one, other in chosen for outcome in outcomes(one, other, levels)]
    return [*_by_level(found, levels), *_by_kind(found)]


# ------------------------------------------------------------------------------------------------------------- pairs


def drawn(one: World, other: World, seed: int) -> list[Pair]:
    """True pairs and others of one drive, or of two, the same for the same seed."""
    rng = np.random.default_rng(seed)
    shelf = SubmapShelf(SubmapSettings(), [one.track, other.track], [one.shelf, other.shelf])
    out = []
    for kind, mask in _masks(one, other).items():
        for i, j in sorted(_draw(rng, mask, COUNTS[kind])):
            true = inverse(one.T_true[i]) @ other.T_true[j]
            out.append(Pair(kind, one is not other, shelf.around(0, i), shelf.around(1, j), true))
    return out


def _masks(one: World, other: World) -> dict[str, Mask]:
    """Which pairs (n, m) of keyframes are of which kind."""
    p, q = one.T_true[:, :3, 3], other.T_true[:, :3, 3]
    a, b = (np.arctan2(w.T_true[:, 1, 0], w.T_true[:, 0, 0]) for w in (one, other))
    step = q[None] - p[:, None]
    flat, lift = np.linalg.norm(step[..., :2], axis=2), np.abs(step[..., 2])
    turn = np.abs((b[None] - a[:, None] + np.pi) % (2 * np.pi) - np.pi)
    along = np.abs(np.cos(a)[:, None] * step[..., 0] + np.sin(a)[:, None] * step[..., 1])
    across = np.abs(np.cos(a)[:, None] * step[..., 1] - np.sin(a)[:, None] * step[..., 0])
    parallel = np.minimum(turn, np.pi - turn) < np.radians(10)
    late = np.ones_like(flat, bool)
    if one is other:
        late = one.track.travelled_m[None] - one.track.travelled_m[:, None] > PATH_M
    again, far = late & (flat < NEAR_M) & (lift < 2), late & (flat > FAR_M)
    return {
        "any": again,
        "opposite": again & (turn > np.radians(150)),
        "little": late & (flat >= NEAR_M) & (flat < LITTLE_M) & (lift < 2),
        "far": far,
        "alike": far & parallel & ((along < 4) | (across < 6)) & (flat < 120),
        "decks": late & (flat < 8) & (lift > 3),
    }


def _draw(rng: np.random.Generator, mask: Mask, count: int) -> list[tuple[int, int]]:
    rows = np.flatnonzero(mask.any(axis=1))
    chosen = rng.choice(rows, count) if len(rows) else rows
    return [(int(i), int(rng.choice(np.flatnonzero(mask[i])))) for i in chosen]


def _noise(rng: np.random.Generator, level: int) -> F8:
    metres, (yaw, pitch, roll) = LEVELS[level - 1]
    turn = np.radians([roll, pitch, yaw]) * rng.standard_normal(3)
    return pose(so3_exp(turn), np.array(metres) * rng.standard_normal(3))


# ----------------------------------------------------------------------------------------------------------- methods


def outcomes(
    one: World, other: World, levels: Sequence[int] = ALL_LEVELS, seed: int = 0
) -> Iterator[Outcome]:
    """All pairs of a meeting; true ones at the levels, others at the highest."""
    pairs = drawn(one, other, seed)
    starts = [pair.T_i_j for pair in pairs if pair.true]
    for number, pair in enumerate(pairs):
        for level in levels if pair.true else (max(levels),):
            rng = np.random.default_rng((seed, number, level))
            start = pair.T_i_j if pair.true else starts[int(rng.integers(len(starts)))]
            yield _outcome(pair, start @ _noise(rng, level), level)


def _outcome(pair: Pair, predicted: F8, level: int) -> Outcome:
    settings, i, j = VerificationSettings(), pair.i, pair.j
    candidate = Candidate(0, 0, 0, 1, float("nan"), float("nan"), predicted, 0.0)
    found = proposals(settings, i, j, prior_of(settings, predicted, float("nan"), i, j))
    verdict = decide(settings, candidate, NO_ARGUMENT, i, j, found)
    correct = {"two_stage": bool(found) and _right(pair, verdict.T_i_j)}
    if pair.true:
        correct["correlative"] = bool(found) and _right(pair, _of_lidars(pair, found[0].T_i_j))
        correct["icp"] = _right(pair, _registered(pair, predicted))
    offset = float(np.linalg.norm(pair.T_i_j[:2, 3]))
    return Outcome(level, pair.kind, pair.second_day, offset, correct, not verdict.reason)


def _registered(pair: Pair, predicted: F8) -> F8:
    """One stage: registration at both resolutions from where odometry puts it."""
    target = Target(pair.i)
    T = inverse(pair.i.T_lidar_level) @ predicted @ pair.j.T_lidar_level
    T = rough(target, pair.j, T).T_target_source
    return _of_lidars(pair, fine(target.fine, pair.j, T).T_target_source)


def _of_lidars(pair: Pair, T_levels: F8) -> F8:
    return pair.i.T_lidar_level @ T_levels @ inverse(pair.j.T_lidar_level)


def _right(pair: Pair, T: F8) -> bool:
    off = se3_log(inverse(pair.T_i_j) @ T)
    return bool(np.linalg.norm(off[3:]) < RIGHT_M and np.degrees(np.linalg.norm(off[:3])) < RIGHT_DEG)


# ----------------------------------------------------------------------------------------------------------- figures


def _by_level(found: Sequence[Outcome], levels: Sequence[int]) -> Iterator[Figure]:
    groups = {
        "": lambda o: True,
        "small_offset.": lambda o: o.offset_m < OFFSET_M,
        "large_offset.": lambda o: o.offset_m >= OFFSET_M,
        "second_day.": lambda o: o.second_day,
    }
    for level in levels:
        at = [o for o in found if o.level == level]
        for group, of in groups.items():
            true = [o for o in at if o.kind in TRUE_KINDS and of(o)]
            how = f"{len(true)} true pairs, pose within {RIGHT_M:g} m and {RIGHT_DEG:g} deg"
            for method in METHODS:
                name = f"{level}.{group}{method}.correct_share"
                yield _share(name, [o.correct[method] for o in true], how)
            both = [o.accepted and o.correct["two_stage"] for o in true]
            yield _share(f"{level}.{group}two_stage.accepted_share", both, f"{how}, and accepted")
        wrong = sum(o.accepted and not (o.kind in TRUE_KINDS and o.correct["two_stage"]) for o in at)
        others = sum(o.kind not in TRUE_KINDS for o in at)
        how = f"accepted with a wrong pose, of {len(at)} pairs, {others} of which do not match"
        yield Figure(f"loops.levels.{level}.two_stage.false_accepted", wrong, "", "run", how)


def _by_kind(found: Sequence[Outcome]) -> Iterator[Figure]:
    for kind in COUNTS:
        of = [o for o in found if o.kind == kind and o.level == max(ALL_LEVELS)]
        if of:
            yield _share(f"5.{kind}.accepted_share", [o.accepted for o in of], f"{len(of)} pairs")


def _share(name: str, values: Sequence[bool], how: str) -> Figure:
    return Figure(f"loops.levels.{name}", float(np.mean(values)) if values else float("nan"), "", "run", how)


# -------------------------------------------------------------------------------------------------------------- main


def _meetings(
    kinds: Sequence[str] = (), seeds: Sequence[int] = (), store: Path | None = None
) -> Iterator[tuple[World, World]]:
    """Every drive with itself; that through a town also with one on another day."""
    from benchmarks.places_worlds import KINDS, SEEDS, simulated, world

    kept = store or Path("build/bench/store")
    for kind in kinds or KINDS:
        for drive in simulated(kind, seeds or SEEDS):
            one = world(drive, kept)
            yield one, one
            if kind == "towns":
                yield one, world(_another_day(drive), kept)


def _another_day(drive: Drive) -> Drive:
    """The same way with other traffic, other parked cars, other noise."""
    settings = {**(drive.simulate or {})}
    settings |= {name: int(settings.get(name, 0)) + 100 for name in ("seed", "parking_seed")}
    return dataclasses.replace(drive, name=f"{drive.name}_again", simulate=settings)


def main() -> None:
    """These figures alone."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs="*", default=[], help="towns, estates; both unless given")
    parser.add_argument("--seeds", nargs="*", type=int, default=[], help="only these")
    parser.add_argument("--levels", nargs="*", type=int, default=list(ALL_LEVELS), choices=ALL_LEVELS)
    parser.add_argument("--store", type=Path, help="where drives are kept")
    options = parser.parse_args()
    found = figures(list(_meetings(options.worlds, options.seeds, options.store)), options.levels)
    print(json.dumps([figure.row() for figure in found if np.isfinite(figure.value)], indent=1))


if __name__ == "__main__":
    main()
