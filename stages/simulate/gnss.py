"""GNSS as a receiver on a vehicle gives it: lost under roofs, misled by houses, and lying when it is told to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.simulated import Lie
from scanloom.stages.geometry.geodesy import georeference, world_to_geodetic
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.motion import Motion
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import cast
from scanloom.stages.simulate.terrain import EAST_X, NORTH_Y
from scanloom.stages.simulate.tracks import stamps, times

GNSS_HZ = 5
SATELLITES = 16
LOWEST_RAD = np.radians(12.0)
SETTLING_S = 6.0
"""After the sky comes back, the receiver needs this long for a fixed solution."""
FIXED_M, CLAIMED_M = 0.012, 0.014
"""Standard deviation of a fixed solution, and what the receiver says of it."""
UPWARDS = np.array([1.0, 1.0, 1.8])
"""How much worse east, north and up are."""
RECOVERY_S, RECOVERY_M = 4.0, 2.5
"""After an outage the first fixes are off by RECOVERY_M, which fades with this time constant."""
LIE_M = (5.0, 30.0)
NO_FIX, FIXED = -1, 2


@dataclass(frozen=True)
class GnssTrack:
    t: F8
    stamp_ns: NDArray[np.int64]
    geodetic: F8
    """Latitude deg, longitude deg, height m (n, 3); NaN without fix."""
    variance_m2: F8
    """East, north, up (n, 3) as the receiver believes."""
    status: NDArray[np.int8]
    error_m: F8
    """What the position is really off by (n, 3); never written to the log."""
    antenna_m: F8
    """Where the antenna truly is (n, 3), east, north, up of the origin; never written to the log."""
    lie: NDArray[np.uint8]
    """`Lie` (n,); never written to the log."""


@dataclass(frozen=True)
class _Fixes:
    """What the receiver finds, before it is turned to degrees."""

    error_m: F8
    claimed_m: F8
    """(n,) horizontal standard deviation it reports."""
    status: NDArray[np.int8]
    lie: NDArray[np.uint8]


def gnss_track(settings: Settings, motion: Motion, scene: Any) -> GnssTrack:
    """Positions of the antenna with the receiver's own idea of their quality.

    Satellites behind houses or under the deck are lost; with few left the fix is coarse or gone. Between high houses the
    receiver takes reflections for signals: it reports a fixed solution and lies by metres, slowly changing. The settings
    can ask for an outage, for more lies and for a clock of its own.
    """
    rng = np.random.default_rng((settings.seed, 33))
    t = times(settings, GNSS_HZ)
    antenna = (motion.poses(t) @ T_BASE["gnss"])[:, :3, 3]
    found = _received(settings, rng, antenna, _visible(settings, scene, antenna).sum(axis=1))
    stamp_ns = stamps(settings, t, rng, settings.gnss_clock_s)
    if settings.gnss_outage_s > 0:
        found = _with_outage(settings, t, found)
    if settings.gnss_lies > 0:
        found = _with_lies(settings, found)
    origin = georeference(settings.latitude_deg, settings.longitude_deg, settings.height_m)
    geodetic = world_to_geodetic(origin, antenna + found.error_m)
    geodetic[found.status == NO_FIX] = np.nan
    variance = (found.claimed_m[:, None] * UPWARDS) ** 2
    return GnssTrack(t, stamp_ns, geodetic, variance, found.status, found.error_m, antenna, found.lie)


def _received(settings: Settings, rng: np.random.Generator, antenna: F8, seen: NDArray[np.int64]) -> _Fixes:
    """Fixes with the number of satellites seen (n,), and with what reflections make of them."""
    n = len(antenna)
    fixed = (seen >= 8) & ~_recently(seen < 6, int(SETTLING_S * GNSS_HZ))
    none = seen < 4
    sigma = np.where(fixed, FIXED_M, np.where(seen >= 6, 0.5, 1.6))
    canyon = _in_canyon(antenna) & (settings.route != "estate")
    misled = _ramp(canyon, 2 * GNSS_HZ)
    slow = _correlated(rng, n, 30 * GNSS_HZ)
    wild = _correlated(rng, n, 10 * GNSS_HZ) + np.array([0.8, -0.5, 0.6])
    error = sigma[:, None] * (0.8 * slow + 0.6 * rng.standard_normal((n, 3))) * UPWARDS
    error = error + settings.gnss_multipath_m * misled[:, None] * 0.6 * wild
    claims_fixed = fixed | (misled > 0.3) & ~none
    return _Fixes(
        error_m=error,
        claimed_m=np.where(claims_fixed, CLAIMED_M, sigma),
        status=np.where(none, NO_FIX, np.where(claims_fixed, FIXED, 0)).astype(np.int8),
        lie=np.where((misled > 0) & ~none, Lie.MULTIPATH, Lie.NONE).astype(np.uint8),
    )


def _with_outage(settings: Settings, t: F8, found: _Fixes) -> _Fixes:
    """No fix for some seconds; the first ones after it are off together while the receiver calls them fixed."""
    rng = np.random.default_rng((settings.seed, 35))
    since = t - (settings.gnss_outage_at_s + settings.gnss_outage_s)
    out = (t >= settings.gnss_outage_at_s) & (since < 0)
    biased = (since >= 0) & (since < 3 * RECOVERY_S) & (found.status != NO_FIX)
    way = _anywhere(rng, 1) * [1.0, 1.0, rng.choice([-1.0, 1.0])]
    bias = RECOVERY_M * np.exp(-np.maximum(since, 0) / RECOVERY_S)[:, None] * way
    return replace(
        found,
        error_m=found.error_m + np.where(biased[:, None], bias, 0.0),
        claimed_m=np.where(biased, CLAIMED_M, found.claimed_m),
        status=np.where(out, NO_FIX, np.where(biased, FIXED, found.status)).astype(np.int8),
        lie=np.where(out, Lie.NONE, np.where(biased, Lie.RECOVERY, found.lie)).astype(np.uint8),
    )


def _with_lies(settings: Settings, found: _Fixes) -> _Fixes:
    """A share of all fixes moved by LIE_M, each its own way, and called fixed."""
    rng = np.random.default_rng((settings.seed, 36))
    n = len(found.status)
    moved = (rng.random(n) < settings.gnss_lies) & (found.status != NO_FIX)
    shift = rng.uniform(*LIE_M, n)[:, None] * _anywhere(rng, n) * [1.0, 1.0, 0.0]
    return replace(
        found,
        error_m=found.error_m + np.where(moved[:, None], shift, 0.0),
        claimed_m=np.where(moved, CLAIMED_M, found.claimed_m),
        status=np.where(moved, FIXED, found.status).astype(np.int8),
        lie=np.where(moved, Lie.MOVED, found.lie).astype(np.uint8),
    )


def _anywhere(rng: np.random.Generator, n: int) -> F8:
    """Directions (n, 3) of unit length on the ground, and as much upwards."""
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.column_stack((np.cos(angle), np.sin(angle), np.ones(n)))


def _visible(settings: Settings, scene: Any, antenna: F8) -> NDArray[np.bool_]:
    """Which satellites (n, SATELLITES) each antenna position sees past houses, trees and decks."""
    rng = np.random.default_rng((settings.seed, 34))
    up = np.arcsin(rng.uniform(np.sin(LOWEST_RAD), 1.0, SATELLITES))
    around = 2 * np.pi * (np.arange(SATELLITES) + rng.uniform(0, 1, SATELLITES)) / SATELLITES
    to_sky = np.column_stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)))
    rays = np.concatenate(
        (np.repeat(antenna, SATELLITES, axis=0), np.tile(to_sky, (len(antenna), 1))), axis=1
    ).astype(np.float32)
    free: NDArray[np.bool_] = ~np.isfinite(cast(scene, rays)["range"]).reshape(len(antenna), SATELLITES)
    return free


def _in_canyon(antenna: F8) -> NDArray[np.bool_]:
    """East Street, between its high houses."""
    x, y = antenna[:, 0], antenna[:, 1]
    return (np.abs(x - EAST_X) < 7) & (y > 12) & (y < NORTH_Y - 12)


def _ramp(inside: NDArray[np.bool_], ticks: int) -> F8:
    """0 outside, 1 inside, with soft edges."""
    box = np.ones(ticks) / ticks
    padded = np.concatenate((np.zeros(ticks), inside.astype(float), np.zeros(ticks)))
    soft: F8 = np.convolve(padded, box, mode="same")[ticks:-ticks]
    return np.minimum(soft, inside)


def _recently(flag: NDArray[np.bool_], ticks: int) -> NDArray[np.bool_]:
    """True from a raised flag on for a number of ticks."""
    reach = np.convolve(np.append(flag, False).astype(float), np.ones(ticks + 1))[: len(flag)]
    return np.asarray(reach > 0)


def _correlated(rng: np.random.Generator, count: int, ticks: int) -> F8:
    """Gauss-Markov noise (count, 3) of unit variance with a correlation time in ticks."""
    from scipy.signal import lfilter

    a = np.exp(-1.0 / ticks)
    white = np.sqrt(1 - a * a) * rng.standard_normal((count, 3))
    white[:1] /= np.sqrt(1 - a * a)
    out: F8 = lfilter([1.0], [1.0, -a], white, axis=0)
    return out
