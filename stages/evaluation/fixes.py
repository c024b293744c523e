"""GNSS of one session: what became of the fixes, by what the receiver said of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tracks import Gnss
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.geometry.factor_rows import FixRows, reason_counts

STATUS = {-1: "no fix", 0: "fix", 1: "satellite-based", 2: "ground-based (RTK)"}
_NAME_OF_REASON = 48
"""Letters of a reason that stand in the name of its figure, at most."""


def fix_figures(gnss: Gnss, fixes: FixRows, georeferenced: bool) -> Iterator[Figure]:
    """Counts by verdict, and per receiver status the share in use and the residuals of all fixes with a position.

    Residuals are those of the solution, also of fixes that were left out; without a georeference there are none.
    """
    yield Figure("gnss.fixes", len(fixes), "", "messages of the receiver")
    yield Figure("gnss.used", int(fixes.used.sum()), "", "fixes that the pose graph uses")
    for reason, count in reason_counts(fixes.verdict[~fixes.used]).items():
        yield Figure(f"gnss.left_out.{_slug(reason)}", count, "", f"fixes left out: {reason}")
    if len(gnss) != len(fixes):
        return
    for status in np.unique(gnss.status):
        rows = np.asarray(gnss.status == status, bool)
        yield from _status_figures(int(status), rows, fixes, georeferenced)


def _status_figures(
    status: int, rows: NDArray[np.bool_], fixes: FixRows, georeferenced: bool
) -> Iterator[Figure]:
    name, about = f"gnss.status_{status}", f"receiver status {status}, {STATUS.get(status, 'unknown')}"
    yield Figure(f"{name}.fixes", int(rows.sum()), "", f"messages with {about}")
    yield Figure(f"{name}.used_share", float(fixes.used[rows].mean()), "", f"share in use of {about}")
    distance = fixes.horizontal_m[rows]
    distance = distance[np.isfinite(distance)]
    if georeferenced and len(distance):
        how = f"horizontal distance of fix and antenna at the solution, used or not; {about}"
        yield Figure(f"{name}.residual_median_m", float(np.median(distance)), "m", f"median {how}")
        yield Figure(f"{name}.residual_p95_m", float(np.quantile(distance, 0.95)), "m", f"95 % {how}")


def _slug(reason: str) -> str:
    """A reason as part of a name: `another_fix_of_the_same_stretch_is_used`."""
    letters = "".join(c if c.isalnum() and c.isascii() else " " for c in reason.lower().replace("'", ""))
    return "_".join(letters.split())[:_NAME_OF_REASON].rstrip("_")
