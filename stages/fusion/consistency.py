"""Loops must agree with each other: two of them and the odometry between their ends close a cycle.

Pairwise consistency (Mangelson et al., ICRA 2018): the cycle's misclosure is compared with the covariance that its parts
state, by chi-square. A cycle through so much odometry that nearly anything would close says nothing. Of loops that
contradict each other those with most contradictions and fewest friends go, one after the other, the later of equals first.
Neighbouring loops that see the same wrong street agree with each other, so friends alone prove nothing: every loop must
also be possible by the rest of the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.stages.fusion.cycles import add_up, close_cycles
from scanloom.stages.fusion.linearization import Stack
from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_exp, se3_log

I8 = NDArray[np.int64]
ALL_PAIRS_UP_TO = 1500
NEIGHBOURS = 64
"""Beyond that many loops, each is compared with this many before and after it along either pass."""
SAME_WAY_M = 5.0
"""Loops nearer than this along both passes close the same way."""
SAME_SIGHT_M = 1.0
"""Loops nearer than this along both passes see the same and may share errors."""
BLIND_RAD = 0.5
VAGUEST = 1e4
"""Variance above which a direction counts as not measured, rad^2 and m^2."""
OWN = 3.0
"""A cycle may also be this many times as uncertain as the loops themselves."""
CONTRADICTS_LOOP = "contradicts another loop through odometry"
CONTRADICTS_REST = "contradicts odometry and GNSS"
UNCONFIRMED = "no other loop confirms it"


class ConsistencySettings(BaseModel):
    """How loops must agree with each other and with the rest of the graph."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_sigma_m: float = Field(
        default=3.0, gt=0, le=1000,
        description="a cycle, or the graph between the ends of a loop, less certain than this confirms nothing, m",
    )  # fmt: skip
    max_sigma_deg: float = Field(
        default=10.0, gt=0, le=90,
        description="a cycle, or the graph between the ends of a loop, less certain than this confirms nothing, deg",
    )  # fmt: skip
    drift_factor: float = Field(
        default=3.0, ge=1, le=100,
        description="a loop may contradict the rest of the graph by this much more than the covariances say: drift of odometry "
        "is no pure random walk",
    )  # fmt: skip


@dataclass(frozen=True)
class Chain:
    """Odometry from node to node, added up: T (n, 4, 4) and covariance S (n, 6, 6) in the frame of its part's first node."""

    part: I8
    """(n,) number of the unbroken stretch a node lies in."""
    T: F8
    S: F8

    def motions(self, i: I8, j: I8) -> tuple[F8, F8]:
        """From nodes i to later nodes j of the same part: (m, 4, 4), and covariances (m, 6, 6) at j."""
        A = adjoint(inverse(self.T[j]))
        return inverse(self.T[i]) @ self.T[j], A @ (self.S[j] - self.S[i]) @ np.swapaxes(A, 1, 2)

    @cached_property
    def travelled_m(self) -> F8:
        """Path length (n,)."""
        step = np.linalg.norm(np.diff(self.T[:, :3, 3], axis=0), axis=1)
        return np.concatenate(([0.0], np.cumsum(np.where(np.diff(self.part) == 0, step, 0.0))))


def chain(n: int, i: I8, Z: F8, C: F8, weighing: F8 | None = None) -> Chain:
    """Of motions Z (m, 4, 4) from nodes i to i + 1 with covariances C; those of the same motion are averaged.

    `weighing` (m, 6, 6) are the covariances by which they are averaged, where C is only a part of them.
    """
    order = np.argsort(i, kind="stable")
    by = C if weighing is None else weighing
    at, motion, covariance = _averaged(i[order], Z[order], C[order], by[order])
    part = np.cumsum(~np.isin(np.arange(n) - 1, at)) - 1
    step, spread = np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6, 6))
    step[at + 1], spread[at + 1] = motion, covariance
    T, S = np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6, 6))
    add_up(part, step, spread, T, S)
    return Chain(part, T, S)


def _averaged(first: I8, Z: F8, C: F8, weighing: F8) -> tuple[I8, F8, F8]:
    """One motion from each node, weighted by information W = weighing^-1: covariance P (sum W C W) P, P = (sum W)^-1."""
    at, start = np.unique(first, return_index=True)
    if len(at) == len(first):
        return at, Z, C
    information = np.linalg.inv(weighing)
    apart = se3_log(inverse(Z[start][np.searchsorted(at, first)]) @ Z)
    whole = np.add.reduceat(information, start, axis=0)
    pull = np.add.reduceat(np.einsum("nij,nj->ni", information, apart), start, axis=0)
    mean = np.linalg.solve(whole, pull[..., None])[..., 0]
    P = np.linalg.inv(whole)
    spread = np.add.reduceat(information @ C @ information, start, axis=0)
    return at, Z[start] @ se3_exp(mean), P @ spread @ P


@dataclass(frozen=True)
class Closures:
    """How far odometry is off between the ends of loops `rows` (m,): error, covariances (m, 6, 6) of loop and way as stated."""

    rows: I8
    error: F8
    C: F8
    ways: tuple[F8, F8, F8]
    """Of the way by rotations alone, by translations alone, by what both share."""
    freedom: I8
    share: F8
    """1 over the number of loops beside a loop along both passes, itself included."""


def closures(chains: Sequence[Chain], loops: Stack, C: F8) -> Closures:
    """Of the loops within one unbroken part of odometry; all of its noise, rotations' alone, translations' alone."""
    way, turning, shifting = chains
    inside = np.flatnonzero(way.part[loops.i] == way.part[loops.j])
    i, j, Z, C = _forward(loops.taken(inside), C[inside])
    (T, whole), (_, turned), (_, shifted) = (c.motions(i, j) for c in (way, turning, shifting))
    ways = turned, shifted, whole - turned - shifted
    _, beside = side_by_side(way, loops.taken(inside), SAME_WAY_M)
    return Closures(inside, se3_log(inverse(Z) @ T), C, ways, loops.freedom[inside], 1.0 / beside)


def side_by_side(way: Chain, loops: Stack, reach_m: float) -> tuple[I8, F8]:
    """Pairs (k, 2) of loops that lie within reach along both passes, and how many lie beside each (m,), itself included."""
    from scipy.spatial import cKDTree

    ends = np.sort(np.column_stack((loops.i, loops.j)), axis=1)
    # Parts follow each other along the axis without ever being near.
    at = way.travelled_m[ends] + way.part[ends] * 1e7
    tree = cKDTree(at)
    beside = tree.query_ball_point(at, reach_m, p=np.inf, return_length=True)
    return tree.query_pairs(reach_m, p=np.inf, output_type="ndarray"), np.asarray(beside, float)


@dataclass(frozen=True)
class Agreement:
    """Pairs of loops (k, 2) whose cycle says something, and whether it closes (k,)."""

    pairs: I8
    closes: NDArray[np.bool_]

    def among(self, chosen: NDArray[np.bool_]) -> Agreement:
        """Only pairs of chosen loops."""
        both = chosen[self.pairs].all(axis=1)
        return Agreement(self.pairs[both], self.closes[both])

    def counts(self, n: int) -> tuple[I8, I8]:
        """Friends and contradictions (n,) of every loop."""
        friends = np.bincount(self.pairs[self.closes].ravel(), minlength=n)
        return friends, np.bincount(self.pairs[~self.closes].ravel(), minlength=n)


def agreement(settings: ConsistencySettings, way: Chain, loops: Stack, C: F8, limit: F8) -> Agreement:
    """Of loops with covariances C (m, 6, 6); limit (7,): chi-square by number of measured directions."""
    pairs = _worth_comparing(loops)
    i, j, Z, C = _forward(loops, C)
    most_m, most_rad = _most(settings, C)
    most_m, most_rad = most_m[pairs].min(axis=1), most_rad[pairs].min(axis=1)
    square, sigma_m, sigma_rad = (
        np.full(len(pairs), np.nan),
        np.full(len(pairs), np.inf),
        np.full(len(pairs), np.inf),
    )
    close_cycles(
        way.part, way.T, way.S, i, j, Z, C, pairs, most_m,
        square, sigma_m, sigma_rad,
    )  # fmt: skip
    tell = (sigma_m <= most_m) & (sigma_rad <= most_rad)
    ratio = square / limit[np.minimum(loops.freedom[pairs[:, 0]], loops.freedom[pairs[:, 1]])]
    # Of many pairs some exceed the limit by chance: between it and twice it they neither agree nor contradict.
    tell &= (ratio <= 1.0) | (ratio > 2.0)
    return Agreement(pairs[tell], ratio[tell] <= 1.0)


def _forward(loops: Stack, C: F8) -> tuple[I8, I8, F8, F8]:
    """Ends, motions and covariances of loops, all from the earlier pose to the later."""
    back = (loops.i > loops.j)[:, None, None]
    A = adjoint(loops.measurement)
    turned = A @ C @ np.swapaxes(A, 1, 2)
    return (
        np.minimum(loops.i, loops.j), np.maximum(loops.i, loops.j),
        np.where(back, inverse(loops.measurement), loops.measurement), np.where(back, turned, C),
    )  # fmt: skip


def contradicting(n: int, found: Agreement) -> NDArray[np.bool_]:
    """Which of n loops to give up until none contradict each other."""
    gone = np.zeros(n, bool)
    friends, enemies = found.counts(n)
    score = enemies - friends
    by_loop: list[list[tuple[int, bool]]] = [[] for _ in range(n)]
    for (a, b), closes in zip(found.pairs.tolist(), found.closes.tolist(), strict=True):
        by_loop[a].append((b, closes))
        by_loop[b].append((a, closes))
    while True:
        open_ = np.flatnonzero((enemies > 0) & ~gone)
        if not len(open_):
            return gone
        worst = int(open_[len(open_) - 1 - int(np.argmax(score[open_][::-1]))])
        gone[worst] = True
        for other, closes in by_loop[worst]:
            enemies[other] -= not closes
            score[other] += 1 if closes else -1


def alone_among(n: int, found: Agreement, gone: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of n loops have no friend among those that stay."""
    pairs = found.pairs[found.closes]
    stay = pairs[~gone[pairs].any(axis=1)]
    return np.asarray(np.bincount(stay.ravel(), minlength=n) == 0)


def squares(residual: F8, C: F8, rest: F8, factor: float) -> F8:
    """Chi-square (m,) of loops against a graph they have no part in.

    residual (m, 6) of the loop there, C (m, 6, 6) its covariance, rest (m, 6, 6) the graph's between its ends, whose
    standard deviations `factor` widens. Zero where the graph's is beyond half a radian: that is no ellipsoid any more.
    """
    whole = C + factor**2 * rest
    square = np.einsum("ni,ni->n", residual, np.linalg.solve(whole, residual[..., None])[..., 0])
    blind = factor**2 * np.diagonal(rest, axis1=1, axis2=2)[:, :3].max(axis=1, initial=0.0) > BLIND_RAD**2
    return np.where(blind, 0.0, square)


def certain(settings: ConsistencySettings, C: F8, rest: F8) -> NDArray[np.bool_]:
    """Whether the graph between the ends of loops (m,) is certain enough to confirm one by itself."""
    most_m, most_rad = _most(settings, C)
    variance = np.diagonal(rest, axis1=1, axis2=2)
    return np.asarray(
        (variance[:, 3:].max(axis=1, initial=0.0) <= most_m**2)
        & (variance[:, :3].max(axis=1, initial=0.0) <= most_rad**2)
    )


def _most(settings: ConsistencySettings, C: F8) -> tuple[F8, F8]:
    """Largest standard deviations (m,) of what may confirm loops with covariances C (m, 6, 6)."""
    variance = np.diagonal(C, axis1=1, axis2=2)
    variance = np.where(variance < VAGUEST, variance, 0.0)
    own_m, own_rad = np.sqrt(variance[:, 3:].max(axis=1)), np.sqrt(variance[:, :3].max(axis=1))
    return np.maximum(settings.max_sigma_m, OWN * own_m), np.maximum(
        np.radians(settings.max_sigma_deg), OWN * own_rad
    )


def _worth_comparing(loops: Stack) -> I8:
    """All pairs (k, 2), or of very many loops those next to each other along either pass."""
    n = len(loops)
    if n <= ALL_PAIRS_UP_TO:
        return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)
    pairs = []
    for order in (np.lexsort((loops.j, loops.i)), np.lexsort((loops.i, loops.j))):
        for gap in range(1, NEIGHBOURS + 1):
            pairs.append(np.column_stack((order[:-gap], order[gap:])))
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0).astype(np.int64)
