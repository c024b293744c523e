"""What the pose graph holds, kind by kind, and how well each fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.pose_graph import Graph
from scanloom.stages.geometry.factor_rows import USED
from scanloom.stages.report.figures import number

_KINDS = ("odometry", "wheel", "loop", "gnss", "gravity", "base", "prior")


@dataclass(frozen=True)
class FactorRow:
    """One kind: how many, how many in use, whitened residuals of those in use before and after the optimisation."""

    kind: str
    count: int
    used: int
    before: str
    after: str


def factor_rows(graph: Graph) -> list[FactorRow]:
    """A row for every kind that the graph holds."""
    kinds = [*_KINDS, *sorted(set(graph.kind) - set(_KINDS))]
    return [_row(graph, kind) for kind in kinds if (graph.kind == kind).any()]


def _row(graph: Graph, kind: str) -> FactorRow:
    rows = np.asarray(graph.kind == kind, bool)
    used = rows & np.asarray(graph.verdict == USED, bool)
    return FactorRow(
        kind,
        int(rows.sum()),
        int(used.sum()),
        _spread(graph.residual_before[used]),
        _spread(graph.residual_after[used]),
    )


def _spread(residuals: NDArray[np.float64]) -> str:
    """Median and 95 % of the finite ones."""
    finite = residuals[np.isfinite(residuals)]
    if not len(finite):
        return "–"
    return f"{number(float(np.median(finite)))} / {number(float(np.quantile(finite, 0.95)))}"
