"""GNSS of one session: what became of the fixes, by what the receiver said of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Poses, Truth
from scanloom.stages.evaluation.figures import Figure
from scanloom.stages.evaluation.trajectories import on_earth
from scanloom.stages.geometry.factor_rows import FixRows, reason_counts
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8

STATUS = {-1: "no fix", 0: "fix", 1: "satellite-based", 2: "ground-based (RTK)"}
WRONG_M, WRONG_SIGMAS = 1.0, 5.0
"""Fixes that are off by more than both are wrong: they claim to be better than they are."""
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
    yield Figure(
        f"{name}.used_share",
        float(fixes.used[rows].mean()),
        "",
        f"share in use of {about}",
        samples=int(rows.sum()),
    )
    distance = fixes.horizontal_m[rows]
    distance = distance[np.isfinite(distance)]
    if georeferenced and len(distance):
        how = f"horizontal distance of fix and antenna at the solution, used or not; {about}"
        yield Figure(
            f"{name}.residual_median_m",
            float(np.median(distance)),
            "m",
            f"median {how}",
            samples=len(distance),
        )
        yield Figure(
            f"{name}.residual_p95_m",
            float(np.quantile(distance, 0.95)),
            "m",
            f"95 % {how}",
            samples=len(distance),
        )


def true_fix_figures(gnss: Gnss, fixes: FixRows, poses: Poses, truth: Truth) -> Iterator[Figure]:
    """What the fixes in use are truly off by, and how many fixes are wrong; where truth and map stand on the Earth."""
    T_world_truth = on_earth(truth, poses)
    if T_world_truth is None or len(gnss) != len(fixes) or len(poses) == 0:
        return
    error_m = _true_errors(fixes, poses, truth, T_world_truth)
    known = np.isfinite(error_m)
    used = error_m[known & fixes.used]
    how = "horizontal error of the fixes in use, by truth"
    if len(used):
        yield Figure(
            "gnss.used_error_median_m", float(np.median(used)), "m", f"median {how}", samples=len(used)
        )
        yield Figure(
            "gnss.used_error_p95_m", float(np.quantile(used, 0.95)), "m", f"95 % {how}", samples=len(used)
        )
    wrong = known & (error_m > WRONG_M) & (error_m > WRONG_SIGMAS * _claimed_sigma(gnss))
    about = f"fixes off by more than {WRONG_M:g} m and {WRONG_SIGMAS:g} times the receiver's own standard deviation"
    yield Figure("gnss.wrong_fixes", int(wrong.sum()), "", about)
    yield Figure("gnss.wrong_used", int((wrong & fixes.used).sum()), "", f"in use of the {about}")


def _true_errors(fixes: FixRows, poses: Poses, truth: Truth, T_world_truth: F8) -> F8:
    """Horizontal error (n,) of each fix, m: its residual at the solution, less the solution's own error there."""
    row = np.clip(np.searchsorted(poses.scan_index, fixes.scan_index), 0, len(poses) - 1)
    stamp_ns = poses.stamp_ns[row]
    true = T_world_truth @ interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamp_ns)
    error = (poses.T_world_lidar[row] - true)[:, :2, 3] - fixes.residual_m[:, :2]
    covered = inside(truth.stamp_ns, stamp_ns) & (poses.scan_index[row] == fixes.scan_index)
    return np.where(covered, np.linalg.norm(error, axis=1), np.nan)


def _claimed_sigma(gnss: Gnss) -> F8:
    """Horizontal standard deviation (n,) as the receiver gives it, 0 where it does not, m."""
    variance = np.diagonal(gnss.covariance_m2, axis1=1, axis2=2)[:, :2].max(axis=1, initial=0.0)
    return np.asarray(np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0.0), 0.0)))


def _slug(reason: str) -> str:
    """A reason as part of a name: `another_fix_of_the_same_stretch_is_used`."""
    letters = "".join(c if c.isalnum() and c.isascii() else " " for c in reason.lower().replace("'", ""))
    return "_".join(letters.split())[:_NAME_OF_REASON].rstrip("_")
