"""Windows: the same log cut or not gives the same trajectory within the covariance, and the same bytes every time."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from pydantic import ValidationError

from scanloom.schemas.product import Parts, columns_of
from scanloom.schemas.scans import DeskewedScan
from scanloom.schemas.trajectory import Odometry
from scanloom.schemas.windows import Window
from scanloom.stages.geometry.se3 import F8, inverse, se3_log
from scanloom.stages.odometry import Settings
from scanloom.stages.odometry.windows import cut, scans_of, windows
from tests.stages.odometry.drives import Drive, drive_along, labelled, parts, step_errors
from tests.worlds import street

CUT = Settings(windows=3, window_overlap_s=1.0)
SEEDS = (2, 7)


def window(first: int, own: int, last: int, **chunk: int) -> Window:
    return Window(first=first, own=own, last=last, **chunk)


def times(count: int) -> np.ndarray:
    return 10**18 + 100_000_000 * np.arange(count)


def test_windows_reach_back_and_own_every_scan_once() -> None:
    found = cut(times(90), 3, 1.0)
    assert found == [window(0, 0, 37), window(27, 37, 63), window(53, 63, 90)]
    assert [w.last - w.first for w in found] == [37, 36, 37], "none has more to track than another"


def test_a_session_too_short_for_its_overlaps_has_fewer_windows() -> None:
    assert cut(times(90), 1, 1.0) == [window(0, 0, 90)]
    assert len(cut(times(81), 4, 1.0)) == 4
    assert len(cut(times(80), 4, 1.0)) == 3
    assert cut(times(20), 4, 1.0) == [window(0, 0, 20)]
    assert len(cut(times(0), 4, 1.0)) == 1


def test_a_window_reaches_back_over_a_pause_but_not_beyond_the_window_before() -> None:
    stamps = times(60)
    stamps[32:] += 10**10
    assert cut(stamps, 2, 1.0) == [window(0, 0, 32), window(22, 32, 60)]
    crowded = np.concatenate((times(10) - 10**12, times(50)[:40] // 10 + 9 * 10**17, times(50)[40:]))
    assert all(b.first >= a.own for a, b in itertools.pairwise(cut(crowded, 3, 300.0)))


class Times:
    """A chunk of which only the index may be read."""

    def __init__(self, stamps: np.ndarray) -> None:
        self.index = [{"reference_ns": int(stamp)} for stamp in stamps]


def test_the_windows_of_a_session_know_their_chunks() -> None:
    stamps = times(90)
    chunks = [(("chunk", f"{k:04d}"),) for k in range(5)]
    scans = Parts(zip(chunks, (Times(stamps[i : i + 20]) for i in range(0, 90, 20)), strict=True))
    found = list(windows(CUT, scans))
    assert [part.key for part in found] == ["0000", "0001", "0002"]
    assert [part.product for part in found] == [
        window(0, 0, 37),
        window(27, 37, 63, chunk=1, chunk_first=20),
        window(53, 63, 90, chunk=2, chunk_first=40),
    ]


@pytest.mark.parametrize("settings", [Settings(), Settings(windows=1), Settings(windows=3)])
def test_a_session_that_is_not_cut_has_no_windows(settings: Settings) -> None:
    """Odometry then tracks it in one go. Nine seconds are too short for windows with ten seconds of overlap."""
    assert list(windows(settings, Parts([((("chunk", "0000"),), Times(times(90)))]))) == []
    assert list(windows(settings, Parts([]))) == []


def test_scans_of_a_window_come_from_the_chunks_it_touches_and_no_other_is_opened() -> None:
    ride = drive_along(street(2), 12)
    whole, labels = parts(ride.scans, 5), parts([labelled(s) for s in ride.scans], 5)
    for first, last, touched in (
        (0, 12, {0, 1, 2}),
        (3, 7, {0, 1}),
        (5, 10, {1}),
        (9, 12, {1, 2}),
        (10, 12, {2}),
    ):
        opened: set[int] = set()
        clouds, classes = (_noting(p, opened) for p in (whole, labels))
        piece = window(first, first, last, chunk=first // 5, chunk_first=first // 5 * 5)
        found = [s.scan_index for s, _ in scans_of(clouds, classes, piece, "a")]
        assert found == list(range(first, last))
        assert opened == touched


def _noting(whole: Parts, opened: set[int]) -> Parts:
    def load(k: int) -> object:
        opened.add(k)
        return whole[k]

    return Parts([((("chunk", f"{k:04d}"),), k) for k in range(len(whole))], load=load)


def test_bounds_of_the_settings() -> None:
    Settings(windows=64, window_overlap_s=300.0)
    for wrong in ({"windows": 65}, {"windows": -1}, {"window_overlap_s": 0.5}):
        with pytest.raises(ValidationError):
            Settings(**wrong)


@pytest.fixture(scope="module")
def rides() -> list[Drive]:
    return [drive_along(street(seed), 66, seed=seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def whole(rides: list[Drive]) -> list[Odometry]:
    return [ride.run() for ride in rides]


@pytest.fixture(scope="module")
def joined(rides: list[Drive]) -> list[Odometry]:
    return [ride.run(CUT) for ride in rides]


def seams(track: Odometry) -> list[int]:
    return [w.own for w in cut(track.stamp_ns, CUT.windows, CUT.window_overlap_s)[1:]]


def differences(a: Odometry, b: Odometry) -> F8:
    """Of the motions between scans, (n - 1, 6)."""
    steps = [inverse(t.T_odom_lidar[:-1]) @ t.T_odom_lidar[1:] for t in (a, b)]
    return se3_log(inverse(steps[0]) @ steps[1])


def test_the_first_window_is_the_whole_run_until_the_first_seam(
    whole: list[Odometry], joined: list[Odometry]
) -> None:
    for a, b in zip(whole, joined, strict=True):
        np.testing.assert_array_equal(a.T_odom_lidar[: seams(b)[0]], b.T_odom_lidar[: seams(b)[0]])
        np.testing.assert_array_equal(a.scan_index, b.scan_index)
        np.testing.assert_array_equal(a.stamp_ns, b.stamp_ns)
        assert b.reliable.all()
        assert not b.segment.any()


def test_seams_agree_with_the_whole_run_within_the_covariance(
    whole: list[Odometry], joined: list[Odometry]
) -> None:
    """Six degrees of freedom at four seams: mean chi-square of the difference is at most that of two independent
    measurements, and more than nothing, since the seam is another estimate."""
    square = []
    for a, b in zip(whole, joined, strict=True):
        off = differences(a, b)
        square += [off[k - 1] @ np.linalg.solve(b.covariance[k], off[k - 1]) for k in seams(b)]
    assert 0.05 < np.mean(square) < 12
    assert max(square) < 35


def test_seams_are_as_wrong_as_their_covariance_says(rides: list[Drive], joined: list[Odometry]) -> None:
    square = []
    for ride, b in zip(rides, joined, strict=True):
        errors = step_errors(b, ride.truth)
        square += [errors[k - 1] @ np.linalg.solve(b.covariance[k], errors[k - 1]) for k in seams(b)]
    assert 0.6 < np.mean(square) < 18, "6 is perfect, below is cautious"


def test_ends_agree(rides: list[Drive], whole: list[Odometry], joined: list[Odometry]) -> None:
    for a, b in zip(whole, joined, strict=True):
        apart = np.linalg.norm((a.T_odom_lidar[-1] - b.T_odom_lidar[-1])[:3, 3])
        assert 1e-6 < apart < 0.1


def test_cut_runs_are_the_same_bytes_however_the_log_is_chunked(
    rides: list[Drive], joined: list[Odometry]
) -> None:
    again = rides[0].run(CUT, chunk=7)
    for name in columns_of(Odometry):
        assert getattr(again, name).tobytes() == getattr(joined[0], name).tobytes(), name


def test_one_window_is_the_uncut_run(rides: list[Drive], whole: list[Odometry]) -> None:
    for settings in (Settings(windows=1), Settings(windows=4, window_overlap_s=60.0)):
        track = rides[0].run(settings)
        for name in columns_of(Odometry):
            assert getattr(track, name).tobytes() == getattr(whole[0], name).tobytes(), name


def test_windows_without_a_common_scan_become_segments(rides: list[Drive]) -> None:
    """No scan of the overlap was registered in both windows: what lies between them is said to be unknown."""
    ride, halves = rides[0], Settings(windows=2, window_overlap_s=1.0)
    second = cut(times(44), 2, 1.0)[1]
    first, own = second.first, second.own
    blind = [
        dataclasses.replace(s, **{name: getattr(s, name)[:0] for name in columns_of(DeskewedScan)})
        for s in ride.scans[first:own]
    ]
    ride = dataclasses.replace(
        ride, scans=ride.scans[:first] + blind + ride.scans[own:44], truth=ride.truth[:44]
    )
    track = ride.run(halves, sensors=False)
    border = np.flatnonzero(np.diff(track.segment)) + 1
    assert own in border
    assert not track.reliable[own]
    assert track.keyframe[own - 1 : own + 1].all()
    assert np.sqrt(track.covariance[own, 3, 3]) > 5
