"""What a receiver says of itself, at the edges of what is believed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from scanloom.schemas.tracks import Gnss
from scanloom.stages.fusion.gnss import judge, middle
from scanloom.stages.fusion.gnss_settings import GnssSettings
from scanloom.stages.fusion.receiver import plausible, screen, since_outage_s
from tests.stages.fusion.drives import gnss_of, odometry_of, rectangle, session_of
from tests.stages.fusion.test_fusion import ODOMETRY, WORLD
from tests.stages.fusion.test_tuning import drives_of

GNSS = gnss_of(WORLD, every=5)
K = 40


def verdicts(gnss: Gnss, **settings: float) -> np.ndarray:
    drive = drives_of(session_of("a", WORLD), gnss, ODOMETRY)[0]
    return screen(GnssSettings(**{"recovery_s": 0.0, **settings}), drive)


def at(k: int = K, **values: float) -> Gnss:
    changed = {name: getattr(GNSS, name).copy() for name in values}
    for name, value in values.items():
        changed[name][k] = value
    return dataclasses.replace(GNSS, **changed)


def test_good_fixes_pass() -> None:
    assert set(verdicts(GNSS)) == {""}


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"status": -1}, "receiver reports no fix"),
        ({"latitude_deg": np.nan}, "receiver reports no fix"),
        ({"height_m": np.inf}, "receiver reports no fix"),
        ({"latitude_deg": 0.0, "longitude_deg": 0.0}, "position is zero: latitude 0, longitude 0"),
        ({"latitude_deg": 90.1}, "no position on the Earth"),
        ({"longitude_deg": 360.1}, "no position on the Earth"),
        ({"longitude_deg": -180.1}, "no position on the Earth"),
        ({"latitude_deg": 84.1}, "beyond the reach of UTM (80 S to 84 N)"),
        ({"latitude_deg": -80.1}, "beyond the reach of UTM (80 S to 84 N)"),
        ({"satellites": 5}, "too few satellites"),
    ],
)
def test_bad_fixes_do_not(values: dict[str, float], reason: str) -> None:
    verdict = verdicts(at(**values), min_satellites=6)
    assert verdict[K] == reason
    assert set(np.delete(verdict, K)) == {""}


@pytest.mark.parametrize(
    "values", [{"latitude_deg": 84.0}, {"latitude_deg": -80.0}, {"longitude_deg": 360.0}, {"satellites": 6}]
)
def test_the_edge_itself_passes(values: dict[str, float]) -> None:
    assert verdicts(at(**values), min_satellites=6)[K] == ""


def test_zero_in_one_coordinate_is_a_place() -> None:
    assert plausible(at(latitude_deg=0.0))[K]
    assert plausible(at(longitude_deg=0.0))[K]
    assert not plausible(at(latitude_deg=0.0, longitude_deg=0.0))[K]


def test_standard_deviation_at_its_limit() -> None:
    covariance = GNSS.covariance_m2.copy()
    covariance[K, 0, 0], covariance[K + 1, 1, 1] = 2.0**2, 2.001**2
    verdict = verdicts(dataclasses.replace(GNSS, covariance_m2=covariance), max_sigma_m=2.0)
    assert verdict[K] == ""
    assert verdict[K + 1] == "receiver's standard deviation too large"


def frozen(count: int) -> np.ndarray:
    """Verdicts when a position is repeated `count` times, 4 m of way apart."""
    held = {k: getattr(GNSS, k).copy() for k in ("latitude_deg", "longitude_deg")}
    for values in held.values():
        values[K : K + count + 1] = values[K]
    return verdicts(dataclasses.replace(GNSS, **held), outage_s=100.0)[K : K + count + 2]


def test_a_position_repeated_while_the_vehicle_drives_is_frozen() -> None:
    for count in (1, 2, 30):
        verdict = frozen(count)
        assert verdict[0] == "", "the first of them still was measured"
        assert set(verdict[1:-1]) == {"position stands still while the vehicle drives"}
        assert verdict[-1] == ""


def test_at_a_crawl_a_repeated_position_is_none() -> None:
    """0.15 m a fix: a run of twenty is 3 m long, one more is beyond it."""
    slow = rectangle(laps=0.2, speed=0.75)
    gnss = gnss_of(slow, every=2)
    track = odometry_of(slow, sigma_t=1e-6)
    for count, stuck in ((19, False), (22, True)):
        held = {k: getattr(gnss, k).copy() for k in ("latitude_deg", "longitude_deg")}
        for values in held.values():
            values[K : K + count + 1] = values[K]
        drive = drives_of(session_of("a", slow), dataclasses.replace(gnss, **held), track)[0]
        verdict = screen(GnssSettings(outage_s=100.0), drive)
        assert ("position stands still while the vehicle drives" in set(verdict)) == stuck


def test_recovery_after_what_was_no_position() -> None:
    latitude = GNSS.latitude_deg.copy()
    latitude[K : K + 10] = np.nan
    verdict = verdicts(dataclasses.replace(GNSS, latitude_deg=latitude), recovery_s=3.0)
    assert set(verdict[K + 10 : K + 16]) == {"recovering after an outage"}
    assert verdict[K + 16] == ""


def test_time_since_an_outage() -> None:
    stamp_ns = (np.array([0.0, 1.0, 3.0, 3.5, 6.6, 7.0, 9.1]) * 1e9).astype(np.int64)
    good = np.array([1, 1, 1, 0, 1, 1, 1], bool)
    found = since_outage_s(stamp_ns, good, 2.0)
    np.testing.assert_allclose(found, [np.inf, np.inf, np.inf, np.inf, 0.0, 0.4, 0.0], atol=1e-9)
    assert np.isinf(since_outage_s(stamp_ns, good, 10.0)).all()
    assert np.isinf(since_outage_s(stamp_ns, np.zeros(7, bool), 2.0)).all()


def test_fixes_after_an_outage_weigh_less_for_a_while() -> None:
    status = GNSS.status.copy()
    status[K : K + 10] = -1
    gnss = dataclasses.replace(GNSS, status=status)
    drive = drives_of(session_of("a", WORLD), gnss, ODOMETRY)[0]
    settings = GnssSettings(recovery_s=5.0, recovery_sigma_m=2.0)
    sigma = judge(settings, drive, screen(settings, drive), middle(gnss), np.eye(3)).sigma_m
    usual = sigma[0]
    np.testing.assert_allclose(usual, [0.2, 0.2, 0.4], rtol=1e-6)
    np.testing.assert_allclose(sigma[K + 20, 0], np.hypot(0.2, 2.0 * np.exp(-1.0)), rtol=1e-3)
    np.testing.assert_allclose(sigma[-1], usual, rtol=0.02)
    assert (sigma[:K] == usual).all()
