"""What a GNSS receiver says of its own fixes, and what is no position to begin with (methods 1.9, gates 1 and 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.drives import I8, Drive
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.geometry.interpolation import inside
from scanloom.stages.geometry.se3 import F8

Texts = NDArray[np.object_]
Flags = NDArray[np.bool_]

RECOVERING = "recovering after an outage"
NOWHERE_DEG = 1e-6
UTM_DEG = (-80.0, 84.0)
FROZEN_M = 3.0
"""Way after which a position that stays the same to the last digit is no measurement any more."""
FRESH_M = 1.0
"""Way up to which the first fixes of such a run are believed."""


def screen(settings: GnssSettings, drive: Drive) -> Texts:
    """First gates, which need no alignment: (n,) empty for fixes that pass, else the reason."""
    verdict = screened(settings, drive)
    mark(verdict, ~inside(drive.odometry.stamp_ns, drive.gnss.stamp_ns), "outside the time of the scans")
    return verdict


def screened(settings: GnssSettings, drive: Drive) -> Texts:
    """As `screen`, but for the time of the fixes, of which the clock is not known yet."""
    gnss = drive.gnss
    verdict = np.full(len(gnss), "", object)
    _implausible(verdict, gnss)
    mark(verdict, (gnss.satellites >= 0) & (gnss.satellites < settings.min_satellites), "too few satellites")
    too_wide = receiver_sigma(settings, gnss)[:, :2].max(axis=1, initial=0.0) > settings.max_sigma_m
    mark(verdict, too_wide, "receiver's standard deviation too large")
    mark(verdict, _frozen(drive, verdict == ""), "position stands still while the vehicle drives")
    late = since_outage_s(gnss.stamp_ns, verdict == "", settings.outage_s) < settings.recovery_s
    mark(verdict, late, RECOVERING)
    return verdict


def mark(verdict: Texts, where: Flags, reason: str) -> None:
    """Set the verdict of fixes that have none yet."""
    verdict[where & (verdict == "")] = reason


def finite(gnss: Gnss) -> Flags:
    """Fixes (n,) whose numbers are numbers."""
    position = np.column_stack((gnss.latitude_deg, gnss.longitude_deg, gnss.height_m))
    return np.asarray(np.isfinite(position).all(axis=1))


def plausible(gnss: Gnss) -> Flags:
    """Fixes (n,) that are a place where a map can be."""
    verdict = np.full(len(gnss), "", object)
    _implausible(verdict, gnss)
    return np.asarray(verdict == "")


def receiver_sigma(settings: GnssSettings, gnss: Gnss) -> F8:
    """Standard deviations (n, 3) east, north, up as the receiver gives them; a guess where it does not, m."""
    variance: F8 = np.diagonal(gnss.covariance_m2, axis1=1, axis2=2)
    variance = np.where(np.isfinite(variance), variance, -1.0)
    told = (variance[:, 0] > 0) & (variance[:, 1] > 0) & (variance[:, 2] >= 0)
    guess = np.array([1.0, 1.0, 2.0]) * settings.unknown_sigma_m
    return np.where(told[:, None], np.sqrt(np.maximum(variance, 0.0)), guess)


def _implausible(verdict: Texts, gnss: Gnss) -> None:
    mark(verdict, (gnss.status < 0) | ~finite(gnss), "receiver reports no fix")
    latitude, longitude = gnss.latitude_deg, gnss.longitude_deg
    with np.errstate(invalid="ignore"):
        nowhere = np.maximum(np.abs(latitude), np.abs(longitude)) < NOWHERE_DEG
        mark(verdict, nowhere, "position is zero: latitude 0, longitude 0")
        off = (np.abs(latitude) > 90.0) | (longitude < -180.0) | (longitude > 360.0)
        mark(verdict, off, "no position on the Earth")
        polar = (latitude < UTM_DEG[0]) | (latitude > UTM_DEG[1])
        mark(verdict, polar, "beyond the reach of UTM (80 S to 84 N)")


def _frozen(drive: Drive, good: Flags) -> Flags:
    """Good fixes (n,) that repeat the position before to the last digit while odometry drives on."""
    gnss, out = drive.gnss, np.zeros(len(good), bool)
    rows = np.flatnonzero(good)
    if len(rows) < 2 or len(drive.odometry) < 2:
        return out
    way = drive.travelled_at(gnss.stamp_ns[rows])
    moved = (np.diff(gnss.latitude_deg[rows]) != 0) | (np.diff(gnss.longitude_deg[rows]) != 0)
    run = np.concatenate(([0], np.cumsum(moved)))
    first = np.flatnonzero(np.concatenate(([True], moved)))
    last = np.concatenate((first[1:], [len(rows)])) - 1
    stuck = (way[last] - way[first])[run] > FROZEN_M
    out[rows] = stuck & (way - way[first][run] > FRESH_M)
    return out


def since_outage_s(stamp_ns: I8, good: Flags, outage_s: float) -> F8:
    """Seconds (n,) from the first good fix after the last pause of `outage_s` without any; infinite before a pause."""
    rows = np.flatnonzero(good)
    out = np.full(len(stamp_ns), np.inf)
    again = rows[1:][np.diff(stamp_ns[rows]) > outage_s * 1e9]
    if len(again):
        last = np.searchsorted(again, np.arange(len(stamp_ns)), side="right") - 1
        known = last >= 0
        out[known] = (stamp_ns[known] - stamp_ns[again[last[known]]]) * 1e-9
    return out
