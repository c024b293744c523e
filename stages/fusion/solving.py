"""The solver: least squares over all poses at once, robust by graduated non-convexity (Yang et al., arXiv 1909.08605).

Odometry, gravity and priors are trusted. Loops and GNSS are doubted: the truncated least-squares cost lets each of them
weigh fully or not at all. Loops must first be possible by odometry and GNSS, and agree with each other. What was refused is
asked again at the solution, and how far the stated covariances of odometry and loops hold is estimated from the residuals
(variance components), so that the next round weighs and doubts by what the data show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.errors import StageError
from scanloom.stages.fusion.consistency import (
    CONTRADICTS_LOOP,
    CONTRADICTS_REST,
    SAME_SIGHT_M,
    UNCONFIRMED,
    Agreement,
    Chain,
    ConsistencySettings,
    agreement,
    alone_among,
    certain,
    chain,
    closures,
    contradicting,
    side_by_side,
    squares,
)
from scanloom.stages.fusion.drives import I8
from scanloom.stages.fusion.factors import BETWEEN, POSITION, PRIOR, Factor
from scanloom.stages.fusion.graduated import checked, graduated
from scanloom.stages.fusion.linearization import Stack
from scanloom.stages.fusion.reduction import Reduction, worthwhile
from scanloom.stages.fusion.scales import (
    LOOP,
    LOWEST,
    LOWEST_BESIDE_FIXES,
    Scales,
    groups,
    of_loops,
    of_odometry,
    shared,
)
from scanloom.stages.fusion.system import System
from scanloom.stages.geometry.se3 import F8


class Effort(TypedDict):
    """How far a solution is carried."""

    iterations: int
    tolerance: float


MANY = 20_000
"""Poses from which on loops are judged on the graph made short, where that halves it at least."""
ROUNDS = 10
MOST_STEPS = 15
REACH, LEAST_REACH_M = 2.5, 0.5
"""Loops are taken together up to this many times the least spread of the graph between their ends, m."""
SETTLED = 0.03
"""Rounds end when no scale changes by more than this share."""
TRIAL: Effort = {"iterations": 15, "tolerance": 1e-3}
"""A graph whose loops are all true is near its optimum after fewer steps; one with false loops never is."""
GROWING: Effort = {"iterations": 8, "tolerance": 1e-3}
"""Between two steps of growth: the next one goes on from there."""
CONTRADICTS_GRAPH = "switched off: contradicts the rest of the graph"


@dataclass(frozen=True)
class Solution:
    """Nodes T (n, 4, 4) at the optimum and their marginal covariances (n, 6, 6), right tangent (rotation, translation)."""

    T: F8
    covariance: F8
    scales: Scales


def solve(
    nodes: F8,
    factors: Sequence[Factor],
    inlier_probability: float,
    consistency: ConsistencySettings | None = None,
) -> Solution:
    """Optimise nodes (n, 4, 4) from their initial values; sets weight and verdict of doubted factors that fail.

    Raises
    ------
    StageError : the graph leaves a pose undetermined.
    """
    active = [f for f in factors if not f.verdict]
    task = _Task(nodes, active, inlier_probability, consistency or ConsistencySettings())
    _determined(len(nodes), task.system)
    try:
        T = task.without_loops()
        task = task.of_possible_loops(T)
        T = task.solved(T)
        covariance = task.system.covariances(T, task.weight).poses
    except FloatingPointError as error:
        raise StageError(
            "the pose graph cannot be solved: it leaves a pose undetermined",
            next_step="look for sessions without odometry, GNSS or loops that tie them to the rest",
        ) from error
    task.tell()
    return Solution(T, covariance, task.scales)


def interpolate_covariances(at: I8, covariance: F8, wanted: I8) -> F8:
    """Covariances (m, 6, 6) at `wanted` (m,) between those at increasing `at` (n,); the end value is kept outside."""
    if len(at) == 1:
        return np.repeat(covariance, len(wanted), axis=0)
    i = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, len(at) - 2)
    share = np.clip((wanted - at[i]) / np.maximum(at[i + 1] - at[i], 1), 0.0, 1.0)[:, None, None]
    return np.asarray(covariance[i] * (1 - share) + covariance[i + 1] * share)


def chi_square_limit(freedom: float, probability: float) -> float:
    """Chi-square up to which a residual of this many directions is an inlier."""
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(freedom / 2.0, probability))


class _Task:
    """One graph on its way to the solution: which doubted factors are in use, and at what scales."""

    def __init__(
        self, nodes: F8, factors: Sequence[Factor], probability: float, settings: ConsistencySettings
    ) -> None:
        self.factors, self.settings, self.nodes = factors, settings, nodes
        self.system = System(len(nodes), factors)
        kind = np.array([f.kind for f in factors], object)
        self.loops, self.gnss = np.flatnonzero(kind == "loop"), np.flatnonzero(kind == "gnss")
        self.probability = probability
        self.limits = np.array([0.0] + [chi_square_limit(k, probability) for k in range(1, 7)])
        self.limit = self.limits[self.system.stack.freedom]
        self.group, self.scales = groups(factors), Scales.as_stated()
        self.weight = np.ones(len(factors))
        self.reason = np.full(len(factors), "", object)
        self._known: tuple[tuple[F8, F8, Stack], F8] | None = None

    def without_loops(self) -> F8:
        """Poses at the optimum of all but loops, in which fixes are doubted."""
        self.weight[self.loops] = 0.0
        return graduated(
            self.system, self.nodes, self.weight, self.gnss, self.limit, loose=bool(len(self.loops))
        )

    def of_possible_loops(self, T: F8) -> _Task:
        """The task without those loops that the graph without loops, at its optimum T, does not allow by far.

        They are refused once and for all: far jumps across the map would fill the system of equations.
        """
        square, _, _ = self._against_rest(T, self.settings.drift_factor)
        impossible = self.loops[square > self.limit[self.loops]]
        if not len(impossible):
            return self
        for k in impossible:
            self.factors[k].weight, self.factors[k].verdict = 0.0, CONTRADICTS_REST
        kept = np.delete(np.arange(len(self.factors)), impossible)
        task = _Task(T, [self.factors[int(k)] for k in kept], self.probability, self.settings)
        task.weight = self.weight[kept]
        return task

    def solved(self, T: F8) -> F8:
        """Poses at the optimum, from that without loops on."""
        if not len(self.loops):
            return T
        short = Reduction.of(self.system.stack, self._chain(), self.loops)
        if worthwhile(len(T), short.kept, MANY):
            T = self.system.optimised(self._judged_on(short, T), self.weight)
            return checked(self.system, T, self.weight, np.concatenate((self._used(), self.gnss)), self.limit)
        together = self._all_at_once(T)
        T = T if together is None else together
        for _ in range(ROUNDS):
            T = self._grown(T)
            T = checked(self.system, T, self.weight, np.concatenate((self._used(), self.gnss)), self.limit)
            changed = self._rescale(T)
            T = self.system.optimised(T, self.weight)
            if changed < SETTLED:
                break
        return T

    def _judged_on(self, short: Reduction, T: F8) -> F8:
        """Which loops and fixes to use, and at what scales, as the short graph tells; poses spread from its optimum."""
        task = _Task(T[short.kept], short.factors(self.factors), self.probability, self.settings)
        rows, stretches = short.rows, len(task.factors) - len(short.rows)
        task.weight[stretches:] = self.weight[rows]
        solved = task.solved(T[short.kept])
        self.weight[rows], self.reason[rows] = task.weight[stretches:], task.reason[stretches:]
        self.scales, scale = task.scales, task.scales.of(self.group)
        scale[rows] = task.system.scale[stretches:]
        self.system.rescale(scale)
        return short.spread(solved)

    def tell(self) -> None:
        """Weights and verdicts into the factors."""
        self.reason[self.gnss] = CONTRADICTS_GRAPH
        for k in np.concatenate((self.loops, self.gnss)):
            used = self.weight[k] > 0
            self.factors[k].weight = float(self.weight[k])
            self.factors[k].verdict = "" if used else str(self.reason[k])

    def _used(self) -> I8:
        return self.loops[self.weight[self.loops] > 0]

    def _all_at_once(self, T: F8) -> F8 | None:
        """The optimum with every loop that nothing speaks against, if all of them fit it and odometry is not bent."""
        found = self._agreement()
        chosen = ~contradicting(len(self.loops), found)
        sure = self._against_rest(T, 1.0)[2]
        chosen &= sure | ~alone_among(len(self.loops), found.among(chosen), ~chosen)
        self.weight[self.loops[chosen]] = 1.0
        trial = self.system.optimised(T, self.weight, loose=True, **TRIAL)
        square, s = self.system.squares(trial), self.system.stack
        bent = self.weight @ square > chi_square_limit(
            float((self.weight * s.freedom).sum()), self.probability
        )
        if bent or (square > self.limit)[self.weight > 0].any():
            self.weight[self.loops] = 0.0
            return None
        return trial

    def _grown(self, T: F8) -> F8:
        """Take loops into use, those first of which the graph is most certain, and so make it certain of others.

        A loop comes in when the graph so far allows it, no better loop contradicts it, and another loop agrees with it or
        the graph itself is certain enough. When none is left, the graph is taken to be less certain than it says.
        """
        found, reach_m = self._agreement(), LEAST_REACH_M
        for factor in (1.0, np.sqrt(self.settings.drift_factor), self.settings.drift_factor):
            for _ in range(MOST_STEPS):
                ready, spread_m = self._ready(T, found, factor)
                if not ready.any():
                    break
                reach_m = REACH * max(reach_m, float(spread_m[ready].min()))
                chosen = self.loops[ready & (spread_m <= reach_m)]
                self.weight[chosen] = 1.0
                T = self._without_misfits(T)
                if not self.weight[chosen].any():
                    break
        return self._tied(T)

    def _tied(self, T: F8) -> F8:
        """A part of the graph that nothing else holds hangs on loops that none confirms: better than nowhere."""
        while True:
            s, L = self.system.stack, self.loops
            part, held = _parts(len(T), s, self.weight > 0)
            reaches = held[part[s.i[L]]] != held[part[s.j[L]]]
            reaches &= (self.weight[L] == 0) & (self.reason[L] == UNCONFIRMED)
            if not reaches.any():
                return T
            self.weight[L[reaches]] = 1.0
            T = self._without_misfits(T)
            if not self.weight[L[reaches]].any():
                return T

    def _ready(self, T: F8, found: Agreement, factor: float) -> tuple[NDArray[np.bool_], F8]:
        """Which loops (m,) could come into use now, and the graph's spread between their ends, m."""
        used = self.weight[self.loops] > 0
        square, spread_m, sure = self._against_rest(T, factor)
        allowed = square <= self.limit[self.loops]
        rivals = found.among(allowed | used)
        gone = contradicting(len(used), rivals)
        lonely = alone_among(len(used), rivals, gone)
        self._explain(gone, lonely & ~sure)
        return np.asarray(allowed & ~used & ~gone & (sure | ~lonely)), spread_m

    def _explain(self, gone: NDArray[np.bool_], unconfirmed: NDArray[np.bool_]) -> None:
        reason = np.full(len(self.loops), CONTRADICTS_GRAPH, object)
        reason[unconfirmed] = UNCONFIRMED
        reason[gone] = CONTRADICTS_LOOP
        self.reason[self.loops] = reason

    def _without_misfits(self, T: F8) -> F8:
        """Optimum of what is in use, after those loops left that do not fit it."""
        T = self.system.optimised(T, self.weight, loose=True, **GROWING)
        used = self._used()
        misfits = used[self.system.squares(T)[used] > self.limit[used]]
        if len(misfits):
            self.weight[misfits] = 0.0
            T = self.system.optimised(T, self.weight, loose=True, **GROWING)
        return T

    def _against_rest(self, T: F8, factor: float) -> tuple[F8, F8, NDArray[np.bool_]]:
        """Chi-square of all loops (m,) against the graph in use, its spread between their ends, m, is it certain there."""
        rest, C = self._rest(T), self.system.covariance_of(self.loops)
        spread_m = np.sqrt(np.trace(rest[:, 3:, 3:], axis1=1, axis2=2))
        square = squares(self.system.errors(self.loops, T), C, rest, factor)
        turned, shifted = self.scales.seen
        seen = np.repeat([turned, max(turned, shifted)], 3)
        return square, spread_m, certain(self.settings, C, rest * seen[:, None] * seen)

    def _rest(self, T: F8) -> F8:
        """Covariances (m, 6, 6) of the graph in use between the ends of all loops."""
        state = (T, self.weight.copy(), self.system.stack)
        if self._known is None or not _same(self._known[0], state):
            s, L = self.system.stack, self.loops
            found = self.system.covariances(T, self.weight, loose=True)
            self._known = state, found.motions(L, s.i[L], s.j[L], T)
        return self._known[1]

    def _agreement(self) -> Agreement:
        L = self.loops
        return agreement(
            self.settings,
            self._chain(),
            self.system.stack.taken(L),
            self.system.covariance_of(L),
            self.limits,
        )

    def _chain(self, stated: tuple[float, float] | None = None) -> Chain:
        """Odometry added up, at the present scales or with the stated covariances times `stated`."""
        s = self.system.stack
        trusted = np.full(len(s), True)
        trusted[self.loops] = False
        rows = np.flatnonzero((s.shape == BETWEEN) & trusted & (s.j == s.i + 1))
        C = self.system.covariance_of(rows, stated)
        whole = self.system.covariance_of(rows, (1.0, 1.0)) if stated is not None else C
        return chain(len(self.nodes), s.i[rows], s.measurement[rows], C, whole)

    def _rescale(self, T: F8) -> float:
        """Scales that loops in use show: of themselves, of what they share, and of odometry at their closures."""
        used = self._used()
        if not len(used):
            return 0.0
        lowest = LOWEST_BESIDE_FIXES if self.weight[self.gnss].any() else LOWEST
        loops = self.system.stated.taken(used)
        loop = of_loops(self.system, T, self.weight, self.loops, self.scales.value[LOOP])
        loop = np.maximum(loop, lowest)
        chains = [self._chain(half) for half in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0))]
        found = closures(chains, loops, self.system.covariance_of(used))
        odometry = of_odometry(found.error, found.C, found.ways, found.freedom, found.share)
        bounded = np.maximum(odometry, lowest)
        new = Scales(np.array([bounded, loop]), odometry / bounded)
        change = new.change(self.scales)
        scale = new.of(self.group)
        pairs, beside = side_by_side(chains[0], loops, SAME_SIGHT_M)
        scale[used] = np.clip(scale[used] * shared(loops.residuals(T), pairs, beside), lowest, None)
        self.scales = new
        self.system.rescale(scale)
        return change


def _same(one: tuple[F8, F8, Stack], other: tuple[F8, F8, Stack]) -> bool:
    return one[0] is other[0] and one[2] is other[2] and np.array_equal(one[1], other[1])


def _determined(n: int, system: System) -> None:
    """Every connected part of the graph needs a factor that says where it is."""
    _, held = _parts(n, system.stack, np.ones(len(system.stack), bool))
    if not held.all():
        raise StageError(
            "the pose graph cannot be solved: nothing says where a part of it lies",
            next_step="look for sessions without odometry, GNSS or loops that tie them to the rest",
        )


def _parts(n: int, stack: Stack, used: NDArray[np.bool_]) -> tuple[I8, NDArray[np.bool_]]:
    """Number (n,) of the connected part each pose lies in, and whether a prior or a position holds each part."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    two = used & (stack.shape == BETWEEN)
    joined = coo_matrix((np.ones(two.sum()), (stack.i[two], stack.j[two])), shape=(n, n))
    parts, part = connected_components(joined, directed=False)
    placed = used & np.isin(stack.shape, (PRIOR, POSITION))
    return part, np.isin(np.arange(parts), part[stack.i[placed]])
