"""GNSS fixes: which of them may speak, and why the others may not (methods 1.9).

Gates in sequence: what the receiver says, recovery after an outage, agreement with the motion odometry saw, one fix
per stretch of path. A receiver in multipath reports a good fix and is metres off; only the third gate and the
solver's own robustness see that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.frames import Georeference
from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.alignment import Alignment, align_level
from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.geometry.geodesy import geodetic_to_world
from scanloom.stages.geometry.interpolation import inside
from scanloom.stages.geometry.se3 import F8

Texts = NDArray[np.object_]

MOST_COMPARED = 2000
"""Fixes a fix is compared with; bounds the time for a vehicle that stands for hours."""


class GnssSettings(BaseModel):
    """Gates and weights of GNSS positions."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_sigma_m: float = Field(
        default=5.0,
        gt=0,
        le=100,
        description="fixes with a larger horizontal standard deviation are left out, m",
    )
    unknown_sigma_m: float = Field(
        default=3.0,
        gt=0,
        le=100,
        description="horizontal standard deviation where the receiver gives none, m",
    )
    min_sigma_m: float = Field(
        default=0.05, gt=0, le=10, description="smallest horizontal standard deviation that is believed, m"
    )
    inflation: float = Field(
        default=2.0, ge=1, le=10, description="factor on standard deviations; fixes share errors over time"
    )
    min_satellites: int = Field(
        default=0, ge=0, le=50, description="fewer satellites: left out; logs that do not tell pass"
    )
    outage_s: float = Field(
        default=2.0, gt=0, le=600, description="a pause this long without good fixes is an outage, s"
    )
    recovery_s: float = Field(
        default=5.0, ge=0, le=600, description="good fixes needed after an outage before one is used, s"
    )
    motion_tolerance_m: float = Field(
        default=0.3, gt=0, le=10, description="disagreement with odometry always allowed, m"
    )
    motion_drift: float = Field(
        default=0.04, gt=0, le=1, description="disagreement with odometry allowed per metre driven"
    )
    chain_m: float = Field(
        default=400.0, gt=10, le=1e5, description="farthest path over which two fixes are compared, m"
    )
    spacing_m: float = Field(default=5.0, ge=0, le=1000, description="one fix is used per this much path, m")
    max_heading_sigma_deg: float = Field(
        default=8.0, gt=0, le=90, description="heading less certain than this: no georeference, deg"
    )


@dataclass(frozen=True)
class Fixes:
    """The fixes of one session in `world`: all of them, with a verdict each."""

    world: F8
    """(n, 3) positions of the antenna, m; NaN without fix."""
    sigma_m: F8
    """(n, 3) standard deviations east, north, up after floors and inflation."""
    verdict: Texts
    """(n,) empty where the fix may enter the graph, else why not."""
    alignment: Alignment | None
    """Of the levelled odometry; None when GNSS does not tell where the session stands."""
    remark: str


def screen(settings: GnssSettings, drive: Drive) -> Texts:
    """First gates, which need no position: (n,) empty for fixes that pass, else the reason."""
    gnss = drive.gnss
    verdict = np.full(len(gnss), "", object)
    sigma = receiver_sigma(settings, gnss)
    position = np.column_stack((gnss.latitude_deg, gnss.longitude_deg, gnss.height_m))
    _mark(verdict, (gnss.status < 0) | ~np.isfinite(position).all(axis=1), "receiver reports no fix")
    _mark(verdict, (gnss.satellites >= 0) & (gnss.satellites < settings.min_satellites), "too few satellites")
    _mark(
        verdict,
        sigma[:, :2].max(axis=1, initial=0.0) > settings.max_sigma_m,
        "receiver's standard deviation too large",
    )
    bad_or_late = _recovering(gnss.stamp_ns, verdict == "", settings.outage_s, settings.recovery_s)
    _mark(verdict, bad_or_late, "recovering after an outage")
    _mark(verdict, ~inside(drive.odometry.stamp_ns, gnss.stamp_ns), "outside the time of the scans")
    return verdict


def receiver_sigma(settings: GnssSettings, gnss: Gnss) -> F8:
    """Standard deviations (n, 3) east, north, up as the receiver gives them; a guess where it does not, m."""
    variance: F8 = np.diagonal(gnss.covariance_m2, axis1=1, axis2=2)
    variance = np.where(np.isfinite(variance), variance, -1.0)
    told = (variance[:, 0] > 0) & (variance[:, 1] > 0) & (variance[:, 2] >= 0)
    guess = np.array([1.0, 1.0, 2.0]) * settings.unknown_sigma_m
    return np.where(told[:, None], np.sqrt(np.maximum(variance, 0.0)), guess)


def judge(
    settings: GnssSettings, drive: Drive, verdict: Texts, origin: Georeference, R_level_odom: F8
) -> Fixes:
    """Remaining gates: agreement with odometry, heading, spacing. `verdict` comes from `screen`."""
    gnss = drive.gnss
    verdict = verdict.copy()
    world = np.full((len(gnss), 3), np.nan)
    finite = np.isfinite(gnss.latitude_deg) & np.isfinite(gnss.longitude_deg) & np.isfinite(gnss.height_m)
    if finite.any():
        world[finite] = geodetic_to_world(
            origin, gnss.latitude_deg[finite], gnss.longitude_deg[finite], gnss.height_m[finite]
        )
    sigma = _weights(settings, gnss)
    passed = np.flatnonzero(verdict == "")
    T = drive.T_odom_lidar_at(gnss.stamp_ns)
    level = (T[:, :3, :3] @ drive.antenna_m + T[:, :3, 3]) @ R_level_odom.T
    path = drive.travelled_at(gnss.stamp_ns)
    horizontal = sigma[:, :2].max(axis=1, initial=0.0)
    alignment = None
    if len(passed) >= 2:
        alignment = align_level(
            level[passed], world[passed], horizontal[passed], path[passed], settings.motion_drift
        )
    remark = _heading_remark(settings, alignment, len(passed))
    if alignment is None or remark:
        _mark(verdict, np.ones(len(verdict), bool), remark)
        return Fixes(world, sigma, verdict, None, remark)
    moved = level @ alignment.T_world_level[:3, :3].T + alignment.T_world_level[:3, 3]
    keep = consistent_chain(
        (world - moved)[passed, :2], path[passed], horizontal[passed] / settings.inflation, settings
    )  # fmt: skip
    _mark(verdict, np.isin(np.arange(len(verdict)), passed[~keep]), "disagrees with the motion odometry saw")
    _mark(
        verdict, ~_spaced(path, verdict == "", settings.spacing_m), "another fix of the same stretch is used"
    )
    return Fixes(world, sigma, verdict, alignment, "")


def consistent_chain(residual: F8, path: F8, sigma_m: F8, settings: GnssSettings) -> NDArray[np.bool_]:
    """The longest chain of fixes whose neighbours agree with odometry.

    `residual` (n, 2) is GNSS minus aligned odometry. Between two fixes it may change by a fixed tolerance, by 3 sigma,
    and by the drift of odometry over the path between them. A stretch of multipath is left out as a whole, since the
    chain through it is shorter than the one around it. Dynamic programming over at most `chain_m` of path.
    """
    n = len(residual)
    length = np.ones(n, np.int64)
    previous = np.full(n, -1, np.int64)
    start = np.maximum(np.searchsorted(path, path - settings.chain_m), np.arange(n) - MOST_COMPARED)
    for k in range(1, n):
        a = np.arange(start[k], k)
        if not len(a):
            continue
        gap = path[k] - path[a]
        allowed = (
            settings.motion_tolerance_m + 3.0 * np.hypot(sigma_m[a], sigma_m[k]) + settings.motion_drift * gap
        )
        fits = np.linalg.norm(residual[k] - residual[a], axis=1) <= allowed
        if fits.any():
            candidates = np.where(fits, length[a], 0)
            at = len(a) - 1 - int(np.argmax(candidates[::-1]))
            length[k], previous[k] = candidates[at] + 1, a[at]
    keep = np.zeros(n, bool)
    k = int(np.argmax(length)) if n else -1
    while k >= 0:
        keep[k] = True
        k = int(previous[k])
    return keep


def _weights(settings: GnssSettings, gnss: Gnss) -> F8:
    sigma = np.maximum(receiver_sigma(settings, gnss), settings.min_sigma_m) * settings.inflation
    sigma[:, 2] = np.maximum(sigma[:, 2], 2.0 * sigma[:, :2].max(axis=1, initial=0.0))
    return np.asarray(sigma)


def _heading_remark(settings: GnssSettings, alignment: Alignment | None, fixes: int) -> str:
    if fixes < 2:
        return "too few good fixes to place the session"
    if alignment is None:
        return "fixes lie too close together to tell the heading"
    sigma_deg = float(np.degrees(alignment.heading_sigma_rad))
    if sigma_deg > settings.max_heading_sigma_deg:
        return f"fixes tell the heading to {sigma_deg:.0f} deg only, too little to place the session"
    return ""


def _mark(verdict: Texts, where: NDArray[np.bool_], reason: str) -> None:
    verdict[where & (verdict == "")] = reason


def _recovering(
    stamp_ns: I8, good: NDArray[np.bool_], outage_s: float, recovery_s: float
) -> NDArray[np.bool_]:
    """Good fixes that come less than `recovery_s` after a pause of `outage_s` without any."""
    out = np.zeros(len(stamp_ns), bool)
    last_good, recovered_at = None, None
    for k in np.flatnonzero(good):
        now = int(stamp_ns[k])
        if last_good is not None and now - last_good > outage_s * 1e9:
            recovered_at = now
        out[k] = recovered_at is not None and now - recovered_at < recovery_s * 1e9
        last_good = now
    return out


def _spaced(path: F8, good: NDArray[np.bool_], spacing_m: float) -> NDArray[np.bool_]:
    """Good fixes at least `spacing_m` of path after the last one taken."""
    out = np.zeros(len(path), bool)
    last = -np.inf
    for k in np.flatnonzero(good):
        if path[k] - last >= spacing_m:
            out[k] = True
            last = path[k]
    return out
