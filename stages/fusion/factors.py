"""Factors of the pose graph as plain data, their residuals, and their rows in the product."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.se3 import F8, inverse, se3_log

USED = "used"


@dataclass
class Factor:
    """One measurement between nodes `i` and `j` (j is -1 for a measurement of one node).

    kind `odometry`, `wheel`, `loop`, `prior`, `base`: `measurement` is the pose of j in i, or of i itself;
    kind `gnss`: position (3,) of the antenna in the last column, `arm_m` the antenna in the frame of node i;
    kind `gravity`: up (3,) in the frame of node i in the last column.
    """

    kind: str
    i: int
    j: int
    measurement: F8
    covariance: F8
    verdict: str = ""
    """Empty for a factor that is in use, else why it is not."""
    arm_m: F8 = field(default_factory=lambda: np.zeros(3))
    weight: float = 1.0

    @property
    def doubted(self) -> bool:
        """The solver may switch it off."""
        return self.kind in ("loop", "gnss")


def whitened_norms(factors: Sequence[Factor], T: F8) -> F8:
    """Norm (m,) of each factor's whitened residual at nodes T (n, 4, 4); NaN where there is no measurement."""
    out = np.full(len(factors), np.nan)
    for kind, residuals in _RESIDUALS.items():
        rows = np.array([k for k, f in enumerate(factors) if f.kind == kind], np.int64)
        if len(rows):
            chosen = [factors[k] for k in rows]
            error, block = residuals(chosen, T)
            covariance = np.array([f.covariance for f in chosen])[:, block, block]
            with np.errstate(invalid="ignore"):
                square = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
                out[rows] = np.sqrt(np.maximum(square, 0.0))
    return out


def _between(factors: Sequence[Factor], T: F8) -> tuple[F8, slice]:
    i, j = np.array([f.i for f in factors]), np.array([f.j for f in factors])
    measured = np.array([f.measurement for f in factors])
    return se3_log(inverse(measured) @ inverse(T[i]) @ T[j]), slice(0, 6)


def _prior(factors: Sequence[Factor], T: F8) -> tuple[F8, slice]:
    measured = np.array([f.measurement for f in factors])
    return se3_log(inverse(measured) @ T[[f.i for f in factors]]), slice(0, 6)


def _gnss(factors: Sequence[Factor], T: F8) -> tuple[F8, slice]:
    at = T[[f.i for f in factors]]
    arm = np.array([f.arm_m for f in factors])
    position = np.einsum("nij,nj->ni", at[:, :3, :3], arm) + at[:, :3, 3]
    return position - np.array([f.measurement[:3, 3] for f in factors]), slice(3, 6)


def _gravity(factors: Sequence[Factor], T: F8) -> tuple[F8, slice]:
    up = np.array([f.measurement[:3, 3] for f in factors])
    world = np.einsum("nij,nj->ni", T[[f.i for f in factors], :3, :3], up)
    return np.column_stack((world[:, 1], -world[:, 0])), slice(0, 2)


_RESIDUALS: dict[str, Callable[[Sequence[Factor], F8], tuple[F8, slice]]] = {
    "odometry": _between,
    "wheel": _between,
    "loop": _between,
    "prior": _prior,
    "base": _prior,
    "gnss": _gnss,
    "gravity": _gravity,
}


def position_residuals(factors: Sequence[Factor], T: F8) -> F8:
    """Antenna minus fix (m, 3) of each factor of kind `gnss` at nodes T (n, 4, 4), m; NaN for the others."""
    out = np.full((len(factors), 3), np.nan)
    rows = np.array([k for k, f in enumerate(factors) if f.kind == "gnss"], np.int64)
    if len(rows):
        out[rows] = _gnss([factors[k] for k in rows], T)[0]
    return out


def graph_table(
    factors: Sequence[Factor], before: F8, after: F8, residual_m: F8, key: Callable[[int], str]
) -> Graph:
    """One row per factor, used or not. `key` names a node."""
    return Graph(
        kind=np.array([f.kind for f in factors], object),
        key_i=np.array([key(f.i) for f in factors], object),
        key_j=np.array([key(f.j) if f.j >= 0 else "" for f in factors], object),
        measurement=np.array([f.measurement for f in factors], float).reshape(-1, 4, 4),
        covariance=np.array([f.covariance for f in factors], float).reshape(-1, 6, 6),
        residual_before=before,
        residual_after=after,
        residual_m=residual_m,
        weight=np.array([0.0 if f.verdict else f.weight for f in factors], float),
        verdict=np.array([f.verdict or USED for f in factors], object),
    )
