"""Precision and recall of a search that gives one answer, or none, to each query.

A query is positive when there is something to find. Answers come with a score, smaller is surer; the curve is what comes
of accepting those up to each score.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.se3 import F8

B1 = NDArray[np.bool_]


@dataclass(frozen=True)
class Curve:
    """Precision and recall (n,) when answers up to each score are accepted; scores increase. Empty without answers."""

    score: F8
    precision: F8
    recall: F8

    def recall_at(self, precision: float) -> float:
        """The highest recall with at least this precision; 0 when it is never reached."""
        reached = self.recall[self.precision >= precision]
        return float(reached.max()) if len(reached) else 0.0

    def f1_max(self) -> float:
        """The highest 2 P R / (P + R)."""
        total = self.precision + self.recall
        f1 = 2 * self.precision * self.recall / np.where(total > 0, total, 1.0)
        return float(f1.max()) if len(f1) else 0.0

    def extended_precision(self) -> float:
        """(P at the smallest recall + R at precision 1) / 2 (Ferrarini et al., RA-L 2020)."""
        if not len(self.precision):
            return 0.0
        return 0.5 * (float(self.precision[0]) + self.recall_at(1.0))


def curve(score: F8, right: B1, positive: B1) -> Curve:
    """The curve over all queries (n,).

    Parameters
    ----------
    score : of the answers; not finite where there is none.
    right : answers that are true. An answer to a query that is not positive cannot be.
    positive : queries to which there is a true answer.
    """
    answered = np.flatnonzero(np.isfinite(score))
    order = answered[np.argsort(score[answered], kind="stable")]
    true = np.cumsum(right[order] & positive[order])
    ordered = score[order]
    last = np.append(ordered[1:] != ordered[:-1], True)[: len(order)]  # equal scores are accepted together
    count = np.arange(1, len(order) + 1)
    precision, recall = true / count, true / max(int(positive.sum()), 1)
    return Curve(ordered[last].astype(float), precision[last], recall[last])
