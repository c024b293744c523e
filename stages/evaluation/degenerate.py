"""Where odometry's registration left a direction to guesswork, and where the motion was lost."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from scanloom.schemas.trajectory import Odometry
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.unseen import SEEN_P, stretches, unseen


def degeneracy_figures(odometry: Odometry) -> Iterator[Figure]:
    """Share of scans with a direction that nothing showed, the longest way driven like that, and the segments."""
    if not len(odometry):
        return
    blind = unseen(odometry)
    how = f"with a direction seen beyond noise with a probability under {SEEN_P:g}"
    yield Figure(
        "odometry.degenerate_share", float(blind.mean()), "", f"share of scans {how}", samples=len(blind)
    )
    travelled = alignment.travelled(odometry.T_odom_lidar)
    longest = max((travelled[b] - travelled[a] for a, b in stretches(blind)), default=0.0)
    yield Figure("odometry.degenerate_longest_m", float(longest), "m", f"longest way without a break {how}")
    segments = len(np.unique(odometry.segment))
    if segments > 1:
        yield Figure("odometry.segments", segments, "", "parts between which the motion was lost")
