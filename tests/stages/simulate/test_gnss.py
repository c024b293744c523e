"""GNSS errs as it is meant to: not less, not more; outages, lies and clock only when asked for."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.simulated import Lie, TrueFixes
from scanloom.stages.geometry.geodesy import geodetic_to_world, georeference
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.simulate.gnss import (
    CLAIMED_M,
    FIXED,
    GNSS_HZ,
    LIE_M,
    NO_FIX,
    RECOVERY_M,
    RECOVERY_S,
    GnssTrack,
    gnss_track,
)
from scanloom.stages.simulate.meshes import Material, box
from scanloom.stages.simulate.motion import Motion, build_motion
from scanloom.stages.simulate.recording import entries
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.sweeping import scene_of
from scanloom.stages.simulate.town import build_town
from scanloom.stages.simulate.tracks import imu_track, wheel_track
from scanloom.stages.simulate.truths import true_fixes

LAP = Settings(duration_s=150.0)
OPEN_SKY = box([-900, -900, -90], [900, 900, -80], Material.GRASS)
TIMES = ("t", "stamp_ns", "geodetic", "variance_m2", "status", "error_m", "lie")


@pytest.fixture(scope="module")
def driven() -> tuple[Motion, GnssTrack]:
    town = build_town(0, 0)
    motion = build_motion(LAP, town.path)
    return motion, gnss_track(LAP, motion, scene_of(town.triangles()[0]))


def under_open_sky(motion: Motion, **asked: float) -> GnssTrack:
    return gnss_track(LAP.model_copy(update={"gnss_multipath_m": 0.0, **asked}), motion, scene_of(OPEN_SKY))


def off(track: GnssTrack) -> F8:
    """How far (n,) reported positions are from where the antenna was, horizontally, m."""
    origin = georeference(LAP.latitude_deg, LAP.longitude_deg, LAP.height_m)
    gap: F8 = geodetic_to_world(origin, *track.geodetic.T) - track.antenna_m
    return np.linalg.norm(gap[:, :2], axis=1)


def test_gnss_lies_by_metres_with_a_good_status(driven: tuple[Motion, GnssTrack]) -> None:
    track = driven[1]
    off = np.linalg.norm(track.error_m[:, :2], axis=1)
    good = track.status == 2
    assert 0.4 < good.mean() < 0.98
    claimed = np.sqrt(track.variance_m2[good, 0])
    assert claimed.max() < 0.05
    assert 0.003 < np.median(off[good]) < 0.04
    assert ((off > 1.0) & good).sum() > 5
    assert off[good].max() < 25.0


def test_without_a_receiver_there_are_no_fixes(driven: tuple[Motion, GnssTrack]) -> None:
    motion, _ = driven
    town = build_town(0, 0)
    none = gnss_track(LAP.model_copy(update={"duration_s": 0.0}), motion, scene_of(town.triangles()[0]))
    assert len(none.t) == 0


def test_gnss_is_silent_in_the_tunnel(driven: tuple[Motion, GnssTrack]) -> None:
    motion, track = driven
    x, y = motion.poses(track.t)[:, 0, 3], motion.poses(track.t)[:, 1, 3]
    inside = (x > 140) & (x < 185) & (np.abs(y) < 4)
    assert inside.sum() > 5
    assert (track.status[inside] == -1).all()
    assert np.isnan(track.geodetic[inside]).all()


def test_reported_positions_are_the_antenna_plus_the_error(driven: tuple[Motion, GnssTrack]) -> None:
    motion, track = driven
    fix = track.status >= 0
    antenna = (motion.poses(track.t) @ T_BASE["gnss"])[:, :3, 3]
    origin = georeference(LAP.latitude_deg, LAP.longitude_deg, LAP.height_m)
    reported = geodetic_to_world(origin, *track.geodetic[fix].T)
    np.testing.assert_allclose(reported, (antenna + track.error_m)[fix], atol=1e-3)


def test_nothing_is_added_unless_asked_for(driven: tuple[Motion, GnssTrack]) -> None:
    """A place for the outage without a length, and lies of share 0, change no number."""
    plain, same = under_open_sky(driven[0]), under_open_sky(driven[0], gnss_outage_at_s=50.0, gnss_lies=0.0)
    for name in TIMES:
        assert getattr(plain, name).tobytes() == getattr(same, name).tobytes(), name
    assert (plain.lie[off(plain) > 0.2] == Lie.MULTIPATH).all()


def test_an_outage_is_silent_and_ends_with_a_bias_called_good(driven: tuple[Motion, GnssTrack]) -> None:
    track = under_open_sky(driven[0], gnss_outage_at_s=40.0, gnss_outage_s=20.0)
    inside = (track.t >= 40.0) & (track.t < 60.0)
    assert inside.sum() == 20 * GNSS_HZ
    assert (track.status[inside] == NO_FIX).all()
    assert np.isnan(track.geodetic[inside]).all()
    assert (track.status[~inside] == FIXED).all()
    first = np.flatnonzero(track.t >= 60.0)[0]
    away = off(track)
    assert 0.9 * RECOVERY_M < away[first] < 1.1 * RECOVERY_M
    assert np.sqrt(track.variance_m2[first, 0]) == pytest.approx(CLAIMED_M)
    assert away[first + int(RECOVERY_S * GNSS_HZ)] == pytest.approx(RECOVERY_M / np.e, abs=0.1)
    recovering = (track.t >= 60.0) & (track.t < 60.0 + 3 * RECOVERY_S)
    assert (track.lie[recovering] == Lie.RECOVERY).all()
    assert away[track.t > 60.0 + 3 * RECOVERY_S].max() < 0.2
    assert away[track.t < 40.0].max() < 0.2


@pytest.mark.parametrize("share", [0.05, 0.2, 1.0])
def test_lies_are_as_many_and_as_large_as_asked_for(driven: tuple[Motion, GnssTrack], share: float) -> None:
    plain, track = under_open_sky(driven[0]), under_open_sky(driven[0], gnss_lies=share)
    lies = track.lie == Lie.MOVED
    assert abs(lies.mean() - share) < 3 * np.sqrt(share * (1 - share) / len(lies)) + 1e-9
    assert (track.status[lies] == FIXED).all()
    np.testing.assert_allclose(track.variance_m2[lies, 0], CLAIMED_M**2)
    assert LIE_M[0] - 0.2 < off(track)[lies].min() < LIE_M[0] + 5
    assert LIE_M[1] - 5 < off(track)[lies].max() < LIE_M[1] + 0.2
    assert plain.geodetic[~lies].tobytes() == track.geodetic[~lies].tobytes()


def test_lies_do_not_fill_an_outage(driven: tuple[Motion, GnssTrack]) -> None:
    track = under_open_sky(driven[0], gnss_lies=1.0, gnss_outage_at_s=10.0, gnss_outage_s=5.0)
    inside = (track.t >= 10.0) & (track.t < 15.0)
    assert (track.status[inside] == NO_FIX).all()
    assert (track.lie[inside] == Lie.NONE).all()


@pytest.mark.parametrize("clock_s", [-0.4, 0.25])
def test_the_receiver_has_a_clock_of_its_own(driven: tuple[Motion, GnssTrack], clock_s: float) -> None:
    plain, late = under_open_sky(driven[0]), under_open_sky(driven[0], gnss_clock_s=clock_s)
    assert plain.geodetic.tobytes() == late.geodetic.tobytes()
    np.testing.assert_allclose((late.stamp_ns - plain.stamp_ns) * 1e-9, clock_s, atol=2e-9)


@pytest.mark.parametrize("known", [True, False])
def test_the_lever_arm_is_told_or_not(driven: tuple[Motion, GnssTrack], known: bool) -> None:
    short = LAP.model_copy(update={"duration_s": 1.0})
    frames = {name: T for name, T in T_BASE.items() if known or name != "gnss"}
    imu, wheel, gnss = imu_track(short, driven[0]), wheel_track(short, driven[0]), under_open_sky(driven[0])
    tf = [
        data for _, topic, _, data in entries(0, iter(()), imu, wheel, gnss, frames) if topic == "/tf_static"
    ]
    assert len(tf) == 1
    assert b"lidar" in tf[0]
    assert (b"gnss" in tf[0]) is known


def test_truth_names_the_fixes_that_lie(driven: tuple[Motion, GnssTrack], tmp_path: Path) -> None:
    track = under_open_sky(driven[0], gnss_lies=0.1, gnss_clock_s=0.3, gnss_outage_s=3.0)
    stream = io.BytesIO()
    true_fixes(LAP.start_s, track).write_to(stream)
    (tmp_path / "fixes.parquet").write_bytes(stream.getvalue())
    fixes = TrueFixes.open(tmp_path / "fixes.parquet")
    assert (fixes.lie == track.lie).all()
    assert np.median(fixes.stamp_ns - fixes.true_ns) == pytest.approx(0.3e9, abs=1e5)
    assert np.isnan(fixes.error_m[: 3 * GNSS_HZ]).all()
    far = np.linalg.norm(fixes.error_m[:, :2], axis=1) > 4.0
    assert far.sum() > 20
    assert (far == (fixes.lie == Lie.MOVED)).all()
