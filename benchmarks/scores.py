"""What is said of a system on a recording, against truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.systems import Outcome
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8, inverse, se3_log

RPE_LENGTHS_M = (1, 5, 10, 20)


@dataclass(frozen=True)
class Figure:
    """One figure, as `--json` writes it."""

    name: str
    value: float
    unit: str
    scope: str
    method: str

    def row(self) -> dict[str, object]:
        return asdict(self)


@dataclass(frozen=True)
class Score:
    """One figure of one system on one recording, without its place in the name."""

    name: str
    value: float
    unit: str
    method: str


def interpolated(truth: Truth, stamp_ns: NDArray[np.int64]) -> tuple[F8, NDArray[np.bool_]]:
    """True poses (m, 4, 4) at those of the stamps (n,) that truth covers, and which these are (n,)."""
    covered = inside(truth.stamp_ns, stamp_ns)
    return interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamp_ns[covered]), covered


def true_poses(truth: Truth, outcome: Outcome) -> tuple[F8, F8]:
    """True poses at the system's own stamps, and the system's, (m, 4, 4) each, where truth has them."""
    true, covered = interpolated(truth, outcome.stamp_ns)
    return true, outcome.T[covered]


def accuracy(truth: Truth, outcome: Outcome, frames: int) -> Iterator[Score]:
    """RPE, KITTI's drift where the path is long enough, ATE."""
    true, estimate = true_poses(truth, outcome)
    yield Score("lost_scans", frames - len(outcome.T), "", "scans after the system lost track")
    if len(outcome.T) < frames:
        return
    for length in RPE_LENGTHS_M:
        errors = alignment.relative_errors(true, estimate, float(length))
        if len(errors):
            how = f"rms error of the motion over {length} m of path, {len(errors)} segments"
            yield Score(f"rpe{length}_m", alignment.rms(errors.translation_m), "m", how)
            yield Score(f"rpe{length}_deg", alignment.rms(np.degrees(errors.rotation_rad)), "deg", how)
    kitti = alignment.kitti_errors(true, estimate)
    if kitti:
        how = f"KITTI odometry benchmark, {kitti.segments} segments of 100 m and more"
        yield Score("kitti_t_rel_percent", kitti.t_rel_percent, "%", how)
        yield Score("kitti_r_rel_deg_per_100m", kitti.r_rel_deg_per_100m, "deg/100m", how)
    yield Score(
        "ate_m", alignment.rms(alignment.absolute_errors(true, estimate)), "m", "rms after rigid alignment"
    )


def cost(outcome: Outcome) -> Iterator[Score]:
    """Time per frame, peak memory, threads."""
    how = f"without reading, {outcome.threads} thread{'s' if outcome.threads > 1 else ''}"
    yield Score("ms_per_frame", float(np.median(outcome.ms)), "ms", f"median, {how}")
    yield Score("ms_per_frame_p95", float(np.percentile(outcome.ms, 95)), "ms", f"95th percentile, {how}")
    yield Score("ms_per_frame_mean", float(outcome.ms.mean()), "ms", f"mean, {how}")
    yield Score("threads", outcome.threads, "", "threads that compute")
    yield from peak(outcome)


def peak(outcome: Outcome) -> Iterator[Score]:
    """Largest memory, when the run was one that reads scan by scan."""
    if np.isfinite(outcome.peak_mb):
        how = "resident memory of the process, interpreter and libraries included, scans read one by one"
        yield Score("peak_rss_mb", outcome.peak_mb, "MB", how)


def with_coarse_truth(said: Sequence[Score], coarse: Truth, outcome: Outcome, frames: int) -> Iterator[Score]:
    """Scores against the reference, and those against the log's own truth: drift and ATE in their place, RPE beside."""
    own = {score.name: score for score in accuracy(coarse, outcome, frames)}
    for score in said:
        if score.name == "ate_m":
            yield dataclasses.replace(
                own.get("ate_m", score), method="rms after rigid alignment; truth: GNSS/INS"
            )
        elif score.name.startswith("rpe"):
            yield dataclasses.replace(score, method=f"{score.method}; reference: scans joined in one graph")
        else:
            yield score
    for name in ("rpe10_m", "rpe10_deg"):
        if name in own:
            method = f"{own[name].method}; truth: GNSS/INS, no better than 0.3 to 0.5 m"
            yield dataclasses.replace(own[name], name=f"{name}_gnss_ins", method=method)


def deskewing(outcome: Outcome) -> Iterator[Score]:
    """Time of deskew."""
    ms, how = outcome.extra["deskew_ms"], "compute only, one core"
    yield Score("deskew_ms_per_frame", float(np.median(ms)), "ms", f"median, {how}")
    yield Score("deskew_ms_per_frame_mean", float(ms.mean()), "ms", f"mean, {how}")
    with_files = float(outcome.extra["deskew_io_ms"])
    yield Score("deskew_ms_per_frame_files", with_files, "ms", "mean, Parquet read and written, one core")


def sensors(outcome: Outcome) -> Iterator[Score]:
    """Time of the check of IMU and wheels; nothing of a result kept from before it was taken."""
    if "sensors_ms" not in outcome.extra:
        return
    ms, how = (
        float(outcome.extra["sensors_ms"]),
        "IMU and wheels checked once per session, one core, from files",
    )
    yield Score("sensors_ms_per_session", ms, "ms", how)
    yield Score("sensors_ms_per_scan", ms / len(outcome.T), "ms", f"{how}; over all scans of the session")


def candour(truth: Truth | None, outcome: Outcome) -> Iterator[Score]:
    """How honest our odometry is about itself; against exact truth where there is such."""
    yield Score(
        "unreliable_scans", int((~outcome.extra["reliable"]).sum()), "", "scans bridged by prediction"
    )
    if truth is not None:
        squares = nees(truth, outcome)
        yield Score(
            "nees", float(squares.mean()), "", "mean over the motions between consecutive scans, 6 is right"
        )
        yield Score("nees_median", float(np.median(squares)), "", "median of the same, 5.35 is right")


def nees(truth: Truth, outcome: Outcome) -> F8:
    """(m,) xi^T C^-1 xi of the motions between consecutive scans; of a calibrated covariance the mean is 6."""
    covered = inside(truth.stamp_ns, outcome.stamp_ns)
    true, estimate = true_poses(truth, outcome)
    both = covered[1:] & covered[:-1]
    wanted = inverse(true[:-1]) @ true[1:]
    found = inverse(estimate[:-1]) @ estimate[1:]
    xi = se3_log(inverse(wanted) @ found)
    C = outcome.extra["covariance"][1:][both]
    squares: F8 = np.einsum("ni,ni->n", xi, np.linalg.solve(C, xi[:, :, None])[:, :, 0])
    return squares
