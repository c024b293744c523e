"""GNSS fixes: which of them may speak, and why the others may not (methods 1.9).

Gates in sequence: what the receiver says, recovery after an outage, agreement with the motion odometry saw, one fix
per stretch of path. A receiver in multipath reports a good fix and is metres off; only the third gate and the
solver's own robustness see that. When most fixes disagree none is believed: better a local frame than a bent map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanloom.schemas.frames import Georeference
from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.agreement import C16, agreeing, longest_chain
from scanloom.stages.fusion.alignment import Alignment, align_level
from scanloom.stages.fusion.drives import Drive
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.fusion.receiver import (
    RECOVERING,
    Flags,
    Texts,
    mark,
    plausible,
    receiver_sigma,
    screen,
    since_outage_s,
)
from scanloom.stages.fusion.walk import Walk, random_walk
from scanloom.stages.geometry.geodesy import geodetic_to_world
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.unseen import SEEN_P

__all__ = ["Fixes", "GnssSettings", "contradictions", "judge", "middle", "positions", "refusals", "screen"]

DISAGREES = "disagrees with the motion odometry saw"
HEIGHT_JUMPS = "height jumps against odometry's"
FEW = 0.02
"""Share of fixes that contradict the motion without a word to the user."""
WHOLE_DRIFT = 0.04
"""Of odometry over a whole session, m per m: how far a fix may lie from the session laid on GNSS as a rigid whole."""
LEAST_WAY_M = 10.0
"""On a shorter way motion tells nothing of the fixes."""


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
    walk: Walk | None = None
    """Of odometry, as these fixes show it."""


def judge(
    settings: GnssSettings, drive: Drive, verdict: Texts, origin: Georeference, R_level_odom: F8
) -> Fixes:
    """Remaining gates: agreement with odometry, heading, spacing. `verdict` comes from `screen`."""
    verdict = verdict.copy()
    world, sigma = positions(drive.gnss, origin), _weights(settings, drive.gnss, verdict)
    passed = np.flatnonzero(verdict == "")
    level, way = antenna_level(drive, R_level_odom), drive.travelled_at(drive.gnss.stamp_ns)
    remark = ""
    if len(passed) > 1 and np.ptp(way[passed]) > LEAST_WAY_M:
        remark = _against_motion(settings, drive, verdict, level, world, way)
    kept = np.flatnonzero(verdict == "")
    alignment = None
    if not remark and len(kept) >= 2:
        horizontal = sigma[kept, :2].max(axis=1, initial=0.0)
        alignment = align_level(level[kept], world[kept], horizontal, way[kept], WHOLE_DRIFT)
    remark = remark or _heading_remark(settings, alignment, len(kept))
    if alignment is None or remark:
        mark(verdict, np.ones(len(verdict), bool), remark)
        return Fixes(world, sigma, verdict, None, remark)
    walk = random_walk(_plane(level[kept]), _plane(world[kept]), way[kept])
    mark(verdict, ~_spaced(way, verdict == "", settings.spacing_m), "another fix of the same stretch is used")
    return Fixes(world, sigma, verdict, alignment, "", walk)


def positions(gnss: Gnss, origin: Georeference) -> F8:
    """Fixes (n, 3) in the frame `world` with its origin there, m; NaN where there is no position on the Earth."""
    world, there = np.full((len(gnss), 3), np.nan), plausible(gnss)
    if there.any():
        world[there] = geodetic_to_world(
            origin, gnss.latitude_deg[there], gnss.longitude_deg[there], gnss.height_m[there]
        )
    return world


def middle(gnss: Gnss) -> Georeference:
    """A frame in the midst of the fixes, wherever some of them may lie; without a projection."""
    there = plausible(gnss)

    def mid(values: F8) -> float:
        """One of the values, so that longitudes on both sides of 180 deg have no mean."""
        return float(np.sort(values[there])[there.sum() // 2]) if there.any() else 0.0

    return Georeference(
        epsg=0, latitude_deg=mid(gnss.latitude_deg), longitude_deg=mid(gnss.longitude_deg), height_m=mid(gnss.height_m),
        easting_m=0, northing_m=0, grid_convergence_rad=0, point_scale=1,
    )  # fmt: skip


def refusals(drives: Sequence[Drive], fixes: Sequence[Fixes]) -> list[str]:
    """Of every session with fixes that GNSS does not place: why, in a sentence."""
    out: dict[str, str] = {}
    placed = {d.name for d, f in zip(drives, fixes, strict=True) if f.alignment is not None}
    local = "" if placed else "; the map has a local frame"
    for d, f in zip(drives, fixes, strict=True):
        if d.name not in placed and len(d.gnss) and d.name not in out:
            reasons, count = np.unique(f.verdict.astype(str), return_counts=True)
            reason = str(reasons[int(np.argmax(count))]) or f.remark
            out[d.name] = f"{d.name}: GNSS is not used: {reason}{local}"
    return list(out.values())


def contradictions(drives: Sequence[Drive], fixes: Sequence[Fixes]) -> list[str]:
    """Of every session of which more than a few fixes contradict the motion: how many."""
    said, counted = [], dict.fromkeys((d.name for d in drives), (0, 0))
    for d, f in zip(drives, fixes, strict=True):
        wrong = sum(str(v) in (DISAGREES, HEIGHT_JUMPS) for v in f.verdict)
        counted[d.name] = (counted[d.name][0] + wrong, counted[d.name][1] + len(f.verdict))
    for name, (wrong, every) in counted.items():
        if wrong > FEW * every:
            share = 100.0 * wrong / every
            said.append(
                f"{name}: {wrong} of {every} GNSS fixes ({share:.0f} %) contradict the motion and are left out"
            )
    return said


def antenna_level(drive: Drive, R_level_odom: F8) -> F8:
    """Antenna (n, 3) at the times of the fixes by odometry, made level, m."""
    T = drive.T_odom_lidar_at(drive.gnss.stamp_ns)
    return np.asarray((T[:, :3, :3] @ drive.antenna_m + T[:, :3, 3]) @ R_level_odom.T)


def _against_motion(
    settings: GnssSettings, drive: Drive, verdict: Texts, level: F8, world: F8, way: F8
) -> str:
    """Mark the fixes that contradict odometry; a remark when too few are left to be believed."""
    gnss, slack = drive.gnss, settings.motion_drift * way + unseen_way_m(drive)
    passed = np.flatnonzero(verdict == "")
    sigma = receiver_sigma(settings, gnss)[passed]
    p, q, driven = _plane(level[passed]), _plane(world[passed]), way[passed]

    def agree(fixes: C16) -> Flags:
        horizontal = sigma[:, :2].max(axis=1, initial=0.0)
        tolerance = settings.motion_tolerance_m
        return agreeing(p, fixes, driven, slack[passed], horizontal, tolerance, settings.chain_m)

    keep = agree(q)
    share = _share_of_way(driven, keep)
    if share < settings.min_agreeing:
        enough = max(settings.min_agreeing, 2.0 * share)
        if _share_of_way(driven, agree(np.conj(q))) >= enough:
            return "positions are mirrored: the sign of latitude or longitude is wrong"
        swapped = _swapped(gnss.take(passed))
        if np.isfinite(swapped).all() and _share_of_way(driven, agree(swapped)) >= enough:
            return "latitude and longitude are swapped"
        return f"fixes contradict the motion of the vehicle on {100 * (1 - share):.0f} % of its way; none is used"
    mark(verdict, np.isin(np.arange(len(verdict)), passed[~keep]), DISAGREES)
    up = (world - level)[passed[keep], 2] + 0j
    loose = settings.height_drift / settings.motion_drift * slack[passed][keep]
    steady = longest_chain(
        up, driven[keep], loose, sigma[keep, 2], settings.height_tolerance_m, settings.chain_m
    )
    mark(verdict, np.isin(np.arange(len(verdict)), passed[keep][~steady]), HEIGHT_JUMPS)
    return ""


def unseen_way_m(drive: Drive) -> F8:
    """Way (n,) up to each fix of which scans did not see every direction, m: there odometry is no judge of GNSS.

    Odometry may have stood still there: a step counts with the vehicle's usual speed when that is more.
    """
    odometry = drive.odometry
    if len(odometry) < 2:
        return np.zeros(len(drive.gnss))
    step_s, step_m = np.diff(odometry.stamp_ns) * 1e-9, np.diff(drive.travelled_m)
    blind = (odometry.direction_p < SEEN_P).any(axis=1) | ~odometry.reliable
    usual_m = np.median(step_m / np.maximum(step_s, 1e-3)) * step_s
    lost = np.concatenate(([0.0], np.cumsum(np.where(blind[1:], np.maximum(step_m, usual_m), 0.0))))
    start = odometry.stamp_ns[0]
    at, known = (drive.gnss.stamp_ns - start).astype(float), (odometry.stamp_ns - start).astype(float)
    return np.asarray(np.interp(at, known, lost))


def _swapped(gnss: Gnss) -> C16:
    """Positions (n,) with latitude and longitude exchanged, m."""
    other = replace(gnss, latitude_deg=gnss.longitude_deg, longitude_deg=gnss.latitude_deg)
    return _plane(positions(other, middle(other)))


def _share_of_way(way: F8, keep: Flags) -> float:
    """Share of the metres with a fix that have one that is kept; a vehicle that stands does not outvote one that drives."""
    metre = np.floor(way).astype(np.int64)
    return float(len(np.unique(metre[keep])) / len(np.unique(metre)))


def _plane(points: F8) -> C16:
    return np.asarray(points[:, 0] + 1j * points[:, 1])


def _weights(settings: GnssSettings, gnss: Gnss, verdict: Texts) -> F8:
    """Standard deviations (n, 3) after floors, inflation and what a receiver is off by when it has just come back."""
    sigma = np.maximum(receiver_sigma(settings, gnss), settings.min_sigma_m) * settings.inflation
    good = (verdict == "") | (verdict == RECOVERING)
    since = since_outage_s(gnss.stamp_ns, good, settings.outage_s)
    fading = settings.recovery_sigma_m * np.exp(-since / max(settings.recovery_s, 1e-3))
    sigma = np.hypot(sigma, fading[:, None])
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


def _spaced(path: F8, good: Flags, spacing_m: float) -> Flags:
    """Good fixes at least `spacing_m` of path after the last one taken."""
    out = np.zeros(len(path), bool)
    last = -np.inf
    for k in np.flatnonzero(good):
        if path[k] - last >= spacing_m:
            out[k] = True
            last = path[k]
    return out
