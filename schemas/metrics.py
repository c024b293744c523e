"""Every metric by name: what it means, whether more of it is better, and what difference is none.

`Metrics` holds values; this list says how to read them. Names may have parts that vary, written as `*`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Literal

Better = Literal["lower", "higher", "target", ""]


@dataclass(frozen=True)
class MetricKind:
    """One metric, or several whose names differ in a part."""

    name: str
    """Dotted; `*` stands for what varies."""
    doc: str
    better: Better = ""
    """Which way is better; empty when a change is neither."""
    absolute: float = 0.0
    """Changes up to this, in the metric's unit, are no regression when nothing is known of its noise."""
    relative: float = 0.0
    """Likewise, as a share of the earlier value; the larger of both counts."""
    truth: bool = False
    """Whether truth is needed to compute it."""
    target: float = 0.0
    """The best value, when `better` says so."""
    absent: float | None = None
    """What it means when the metric is not there; None when that means nothing."""
    varies: bool = False
    """Depends on the machine and what else it does: judged only when its noise has been measured."""

    def badness(self, value: float) -> float:
        """Grows as the metric gets worse; 0 for one that is neither."""
        if self.better == "target":
            return abs(value - self.target)
        return {"lower": value, "higher": -value, "": 0.0}[self.better]

    def tolerance(self, before: float) -> float:
        """How much worse than an earlier value is still no regression."""
        return max(self.absolute, self.relative * abs(before))


def _errors(of: str) -> Iterator[MetricKind]:
    """What odometry and the map's poses have in common."""
    yield MetricKind(
        f"{of}.ate_rmse_m",
        "root mean square error of position after one rigid alignment",
        "lower",
        0.05,
        0.15,
        True,
    )
    yield MetricKind(
        f"{of}.ate_max_m", "largest error of position after one rigid alignment", "lower", 0.1, 0.25, True
    )
    yield MetricKind(
        f"{of}.rpe*_m", "error of the motion over so many metres of path", "lower", 0.005, 0.15, True
    )
    yield MetricKind(
        f"{of}.rpe*_deg", "error of the turn over so many metres of path", "lower", 0.005, 0.15, True
    )
    yield MetricKind(
        f"{of}.kitti_t_rel_percent", "drift of the KITTI odometry benchmark", "lower", 0.02, 0.1, True
    )
    yield MetricKind(
        f"{of}.kitti_r_rel_deg_per_100m",
        "turn per way of the KITTI odometry benchmark",
        "lower",
        0.01,
        0.15,
        True,
    )
    yield MetricKind(f"{of}.path_length_m", "way driven, from scan to scan")


# fmt: off
METRICS: tuple[MetricKind, ...] = (
    MetricKind("map.tiles", "tiles of the map"),
    MetricKind("map.points", "points of all tiles"),
    MetricKind("map.area_m2", "squares of 1 m that hold a point, seen from above"),
    MetricKind("map.mme_r*_nat", "mean map entropy within a radius: blur of the map, lower is crisper", "lower", 0.03),
    MetricKind("map.mme_r*_share", "share of the map's points with enough neighbours for an entropy"),
    MetricKind("map.mpv_r*_m2", "mean plane variance: least variance of the points within a radius", "lower", 1e-4, 0.05),
    MetricKind("map.plane_sigma_median_m", "median thickness of the map's neighbourhoods, one standard deviation", "lower", 0.001, 0.05),
    MetricKind("map.wall_patches", "patches of upright surfaces that were judged"),
    MetricKind("map.wall_thickness_median_m", "median thickness of upright surfaces", "lower", 0.005, 0.1),
    MetricKind("map.wall_thickness_p90_m", "90 % of the upright surfaces are thinner", "lower", 0.02, 0.1),
    MetricKind("map.wall_double_share", "share of upright surfaces with two layers where there is one wall", "lower", 0.01, 0.25),
    MetricKind("map.wall_double_gap_median_m", "median distance of the layers of double walls"),
    MetricKind("map.wall_two_sided_share", "share of upright surfaces with two true sides, as garden walls have"),
    MetricKind("map.overlap_share", "share of the map's points that were met again on a later pass"),
    MetricKind("map.overlap_area_share", "share of the map's area that was met again on a later pass"),
    MetricKind("map.overlap_sessions_share", "share of the map's points that were met again by another session"),
    MetricKind("map.ground_density_median", "points of the map per m2 of ground", "higher", 2.0, 0.1),
    MetricKind("map.ground_density_p10", "a tenth of the ground has fewer points per m2"),
    MetricKind("map.surface_density_median", "points of the map per m2 of surfaces", "higher", 2.0, 0.1),
    MetricKind("map.surface_density_p10", "a tenth of the surfaces has fewer points per m2"),
    MetricKind("map.surface_density_p90", "a tenth of the surfaces has more points per m2"),
    MetricKind("map.returns_per_point", "measured points averaged in one point of the map"),
    *_errors("fusion"),
    MetricKind("fusion.absolute_rmse_m", "root mean square error of position on the Earth, nothing aligned", "lower", 0.05, 0.15, True),
    MetricKind("fusion.absolute_max_m", "largest error of position on the Earth, nothing aligned", "lower", 0.1, 0.25, True),
    MetricKind("fusion.nees_translation", "squared error of position over its marginal covariance, 3 is honest", "target", 1.0, 0.25, True, 3.0),
    MetricKind("fusion.inter_session_rmse_m", "error of one session's keyframes in another's", "lower", 0.03, 0.15, True),
    MetricKind("fusion.inter_session_rmse_deg", "turn of one session's keyframes in another's", "lower", 0.03, 0.15, True),
    MetricKind("fusion.georeferenced", "1 when the map has a place on the Earth", "higher"),
    *_errors("odometry"),
    MetricKind("odometry.scans", "scans with a pose from odometry", "higher", 0.0, 0.01),
    MetricKind("odometry.unreliable_scans", "scans whose motion was bridged by prediction", "lower", 5.0, 0.2),
    MetricKind("odometry.degenerate_share", "share of scans with a direction of motion that went unseen", "lower", 0.02, 0.2),
    MetricKind("odometry.degenerate_longest_m", "longest way with a direction of motion that went unseen", "lower", 5.0, 0.2),
    MetricKind("odometry.segments", "parts between which the motion was lost; none when it never was", "lower", absent=1.0),
    MetricKind("loops.candidates", "pairs of places compared"),
    MetricKind("loops.verified", "pairs that passed the geometric tests"),
    MetricKind("loops.accepted", "pairs that the pose graph uses", "higher", 2.0, 0.2),
    MetricKind("loops.between_sessions", "pairs in use that join two sessions", "higher", 2.0, 0.2),
    MetricKind("loops.verified_precision", "share of right ones among the verified pairs", "higher", 0.02, 0.0, True),
    MetricKind("loops.precision", "share of right ones among the accepted pairs", "higher", 0.0, 0.0, True),
    MetricKind("loops.recall", "share of revisits with a right accepted loop", "higher", 0.05, 0.0, True),
    MetricKind("loops.search_r*", "the search alone, against places within so many metres in truth", "higher", 0.05, 0.0, True),
    MetricKind("gnss.fixes", "messages of the receiver"),
    MetricKind("gnss.used", "fixes that the pose graph uses"),
    MetricKind("gnss.left_out.*", "fixes left out, by the reason"),
    MetricKind("gnss.status_*.fixes", "messages by the receiver's own status"),
    MetricKind("gnss.status_*.used_share", "share in use by the receiver's own status"),
    MetricKind("gnss.status_*.residual_median_m", "median distance of fixes to the antenna of the map", "lower", 0.05, 0.2),
    MetricKind("gnss.status_*.residual_p95_m", "95 % of the fixes are nearer to the antenna of the map", "lower", 0.2, 0.3),
    MetricKind("gnss.used_error_median_m", "median true error of the fixes in use", "lower", 0.05, 0.2, True),
    MetricKind("gnss.used_error_p95_m", "95 % of the fixes in use are truly nearer", "lower", 0.1, 0.3, True),
    MetricKind("gnss.wrong_fixes", "fixes that are far more wrong than they claim", "", 0.0, 0.0, True),
    MetricKind("gnss.wrong_used", "of these those that the pose graph uses", "lower", 2.0, 0.2, True),
    MetricKind("truth.path_length_m", "way driven by truth", "", 0.0, 0.0, True),
    MetricKind("truth.scans", "scans within the time range of truth", "", 0.0, 0.0, True),
    MetricKind("truth.scans_outside", "scans outside the time range of truth, left out", "", 0.0, 0.0, True),
    MetricKind("sensors.imu_clock_offset_s", "how much later the IMU's stamps are than the LiDAR's"),
    MetricKind("sensors.wheel_clock_offset_s", "how much later the wheels' stamps are than the LiDAR's"),
    MetricKind("sensors.wheel_ratio", "true speed over the wheels' as logged"),
    MetricKind("sensors.contradicting", "IMU and wheels that fit the motion in no known way", "lower"),
    MetricKind("camera.*.nid", "normalised information distance of images and reflectance, as calibrated", "lower", 0.005, 0.01),
    MetricKind("camera.*.offset_deg", "turn of a camera since its calibration", "lower", 0.2, 0.0),
    MetricKind("camera.*.offset_std_deg", "standard deviation of that"),
    MetricKind("camera.moved", "cameras that have turned since their calibration", "lower"),
    MetricKind("clean.mme_with_removed_nat", "mean map entropy with what was left out of the map"),
    MetricKind("clean.mme_without_removed_nat", "mean map entropy at the same points without it"),
    MetricKind("clean.*_points", "points left out of the map, by class"),
    MetricKind("clean.*_share", "share of the points left out of the map, by class"),
    MetricKind("calibration.leave_one_out_px", "corners of a placement from the LiDAR's board, by a calibration without it", "lower", 0.2, 0.15),
    MetricKind("calibration.leave_one_out_cm", "the same on the board's plane", "lower", 0.05, 0.15),
    MetricKind("calibration.leave_one_out_as_read_px", "the same with the board where the cloud alone has it", "lower", 0.2, 0.15),
    MetricKind("calibration.held_out_*", "the same by calibrations of random halves, on the other half", "lower", 0.2, 0.2),
    MetricKind("calibration.residual_px", "corners from the LiDAR's boards, by the calibration of all placements", "lower", 0.2, 0.15),
    MetricKind("calibration.*.leave_one_out_*", "of one camera", "lower", 0.2, 0.15),
    MetricKind("calibration.*.halves_max_*", "largest difference of calibrations from random halves to their mean", "lower", 0.05, 0.3),
    MetricKind("calibration.*.sigma_*", "largest standard deviation of a turn or shift", "lower", 0.05, 0.2),
    MetricKind("calibration.placements_*", "placements in use and left out"),
    MetricKind("calibration.lidar_*_mm", "what the LiDAR was found to be off by"),
    MetricKind("calibration.good", "1 when nothing speaks against the calibration", "higher"),
    MetricKind("changes.points", "standing points of the old map that new sessions saw through"),
    MetricKind("changes.objects", "such points gathered by distance"),
    MetricKind("run.wall_s", "from the start of the command to the delivery of the map", "lower", 5.0, 0.3, varies=True),
    MetricKind("run.log_s", "length of all logs"),
    MetricKind("run.realtime_factor", "seconds of log per second of run", "higher", 0.2, 0.3, varies=True),
    MetricKind("run.peak_rss_mb", "resident memory of all processes together", "lower", 200.0, 0.25, varies=True),
    MetricKind("run.tasks*", "tasks of the run"),
)
# fmt: on


@lru_cache(maxsize=4096)
def kind_of(name: str) -> MetricKind | None:
    """What is known of a metric; None when nothing is."""
    return next((kind for kind in METRICS if fnmatchcase(name, kind.name)), None)
