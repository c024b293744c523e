"""The tracker in a world of boxes: what drives is found with its size and speed, what stands is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.objects import ObjectClass, ObjectTracks
from scanloom.schemas.product import columns_of
from scanloom.stages.objects import Settings
from scanloom.stages.objects.paths import dynamic_rows
from tests.stages.objects.film import CAR, PERSON, Film, box, film, straight
from tests.worlds import GROUND_Z_M, street

HOUSE = [[-60.0, -14.0, GROUND_Z_M], [60.0, -9.0, 6.0]]


def main_track(tracks: ObjectTracks) -> ObjectTracks:
    """The longest track."""
    return tracks.take(tracks.track == np.bincount(tracks.track).argmax())


@pytest.fixture(scope="module")
def oncoming() -> Film:
    return film(straight(45, 6.0), lambda t: [box(55.0 - 8.0 * t, 3.5), HOUSE])


def test_an_oncoming_car_is_covered_with_its_size_and_speed(oncoming: Film) -> None:
    tracks = oncoming.tracks()
    assert 0.97 < oncoming.covered(tracks, 0) <= 1.0
    car = main_track(tracks)
    assert np.bincount(tracks.track).max() > 0.9 * len(tracks)
    assert 3.9 < car.length_m[0] < 4.8
    assert 1.3 < car.width_m[0] < 2.1
    assert 1.4 < car.height_m[0] < 2.1
    assert 7.8 < np.median(car.speed_m_s) < 8.2
    assert (car.class_ == ObjectClass.VEHICLE).all()
    assert car.dynamic.all()
    forward = car.T_odom_object[:, :3, 0]
    assert (forward[:, 0] < -0.98).all()
    assert np.allclose(car.T_odom_object[:, 2, 3], GROUND_Z_M, atol=0.1)


def test_box_in_the_scan_is_the_box_in_odometry(oncoming: Film) -> None:
    tracks = oncoming.tracks()
    T = oncoming.odometry(None, ()).T_odom_lidar[tracks.scan_index]
    assert np.allclose(T @ tracks.T_lidar_object, tracks.T_odom_object, atol=1e-9)


def test_the_same_bytes_every_time_and_for_any_chunks(oncoming: Film) -> None:
    first, second = oncoming.tracks(), oncoming.tracks(chunk=7)
    for name in columns_of(ObjectTracks):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_a_sensor_upside_down_sees_the_same_car() -> None:
    turned = film(straight(30, 6.0), lambda t: [box(40.0 - 8.0 * t, 3.5)], upside_down=True)
    tracks = turned.tracks()
    car = main_track(tracks)
    assert 7.6 < np.median(car.speed_m_s) < 8.4
    assert (car.T_odom_object[:, 2, 2] < -0.99).all()


def test_a_car_ahead_that_drives_as_fast_as_we_do() -> None:
    ahead = film(straight(40, 8.0), lambda t: [box(14.0 + 8.0 * t, 0.3), HOUSE])
    tracks = ahead.tracks()
    assert 0.97 < ahead.covered(tracks, 0) <= 1.0
    assert 7.7 < np.median(main_track(tracks).speed_m_s) < 8.3


def test_a_car_that_waits_and_leaves_is_dynamic_for_all_the_time_it_stood() -> None:
    def boxes(t: float) -> list[list[list[float]]]:
        return [box(18.0 + max(t - 3.0, 0.0) ** 2, 3.5), HOUSE]

    waiting = film(straight(60), boxes)
    tracks = waiting.tracks()
    car = main_track(tracks)
    assert car.scan_index[0] <= 1
    assert car.dynamic.all()
    assert (car.speed_m_s[:20] < 0.3).all()
    assert 0.95 < waiting.covered(tracks, 0) <= 1.0


@pytest.mark.parametrize(("stands_s", "parked"), [(3.0, False), (7.0, True)])
def test_a_car_that_comes_to_rest_is_dynamic_while_it_drove_and_parked_if_it_stands_long(
    stands_s: float, parked: bool
) -> None:
    def boxes(t: float) -> list[list[list[float]]]:
        return [box(30.0 - 6.0 * min(t, 2.5), 3.5), HOUSE]

    car = main_track(film(straight(round((2.5 + stands_s) * 10)), boxes).tracks())
    assert car.dynamic[car.scan_index < 20].all()
    assert car.dynamic[car.scan_index > 32].any() != parked


@pytest.mark.parametrize(("stands_s", "parked"), [(4.9, False), (5.2, True)])
@pytest.mark.parametrize("last_m", [0.0, 0.4])
def test_it_has_parked_even_if_its_last_place_is_off(stands_s: float, parked: bool, last_m: float) -> None:
    t = np.arange(0.0, 4.0 + stands_s, 0.1)
    x = 3.0 * np.minimum(t, 4.0)
    x[-1] += last_m
    dynamic = dynamic_rows(Settings(), t, np.column_stack((x, np.zeros(len(t)))))
    assert dynamic[t < 3.8].all()
    assert dynamic[t > 4.1].any() != parked


@pytest.mark.parametrize(("rest_m", "parked"), [(0.69, False), (0.71, True)])
def test_what_wanders_by_less_than_its_length_explains_has_parked(rest_m: float, parked: bool) -> None:
    t = np.arange(0.0, 13.0, 0.1)
    x = 3.0 * np.minimum(t, 4.0)
    x[-8:] += 0.7
    dynamic = dynamic_rows(Settings(), t, np.column_stack((x, np.zeros(len(t)))), rest_m)
    assert dynamic[t < 3.7].all()
    assert dynamic[t > 4.3].any() != parked


@pytest.mark.parametrize("side_m", [3.2, 4.5])
def test_a_bus_that_halts_while_we_pass_and_drives_on_is_covered_all_the_time(side_m: float) -> None:
    def boxes(t: float) -> list[list[list[float]]]:
        drives = min(t, 3.0) + max(t - 8.0, 0.0)
        front, side = 38.0 - 5.0 * drives, side_m
        return [[[front, side - 1.25, GROUND_Z_M], [front + 11.0, side + 1.25, GROUND_Z_M + 3.0]], HOUSE]

    bus = film(straight(105, 3.0), boxes)
    tracks = bus.tracks()
    assert main_track(tracks).dynamic.all()
    assert 10.0 < main_track(tracks).length_m[0] < 12.0
    assert 0.95 < bus.covered(tracks, 0) <= 1.0


@pytest.mark.parametrize("side_m", [2.4, 3.5, 6.0])
def test_parked_cars_that_show_more_of_themselves_in_passing_do_not_move(side_m: float) -> None:
    def boxes(t: float) -> list[list[list[float]]]:
        return [box(x, side_m) for x in (8.0, 13.5, 19.0, 30.0)] + [box(12.0, -side_m), HOUSE]

    assert len(film(straight(50, 8.0), boxes).tracks()) == 0


def test_a_wall_that_gaps_let_through_does_not_move() -> None:
    wall = [[-10.0, 8.0, GROUND_Z_M], [60.0, 8.3, 1.2]]
    gaps = [box(x, 4.5, (3.0, 0.4, 2.5)) for x in np.arange(-4.0, 50.0, 5.0)]
    assert len(film(straight(45, 7.0), lambda t: [*gaps, wall]).tracks()) == 0


def test_nothing_moves_in_a_street_while_the_vehicle_turns_fast() -> None:
    near = [b for b in street(3).boxes if abs(b[:, 0].mean()) < 25.0]
    turning = film(straight(30, 4.0, np.radians(40.0)), lambda t: near)
    assert len(turning.tracks()) == 0


def test_a_car_is_found_while_the_vehicle_turns_fast() -> None:
    turning = film(straight(40, 3.0, np.radians(40.0)), lambda t: [box(-15.0 + 6.0 * t, 12.0)])
    tracks = turning.tracks()
    assert 0.95 < turning.covered(tracks, 0) <= 1.0
    assert 5.7 < np.median(main_track(tracks).speed_m_s) < 6.3


def test_a_person_who_walks_across() -> None:
    walking = film(straight(40), lambda t: [box(9.0, -4.0 + 1.4 * t, PERSON), HOUSE])
    tracks = walking.tracks()
    person = main_track(tracks)
    assert (person.class_ == ObjectClass.PERSON).all()
    assert 1.2 < np.median(person.speed_m_s) < 1.6
    assert 0.95 < walking.covered(tracks, 0) <= 1.0


def test_a_bus_is_a_truck_by_its_size() -> None:
    bus = film(straight(45, 4.0), lambda t: [box(45.0 - 7.0 * t, 4.0, (11.0, 2.5, 2.9))])
    tracks = bus.tracks()
    assert (main_track(tracks).class_ == ObjectClass.TRUCK).all()
    assert 9.0 < main_track(tracks).length_m[0] < 12.0


def test_less_than_the_least_displacement_is_no_motion() -> None:
    creeping = film(straight(40), lambda t: [box(12.0 + 0.15 * t, 3.5)])
    assert len(creeping.tracks()) == 0
    assert len(creeping.tracks(settings=Settings(min_displacement_m=10.0))) == 0


def test_a_track_ends_with_its_segment(oncoming: Film) -> None:
    cut = 20
    tracks = oncoming.tracks(segments=[0] * cut + [1] * (len(oncoming.scans) - cut))
    for number in np.unique(tracks.track):
        scans = tracks.scan_index[tracks.track == number]
        assert scans.max() < cut or scans.min() >= cut
    assert (tracks.scan_index >= cut).any() and (tracks.scan_index < cut).any()


def test_scans_without_pose_are_passed_over(oncoming: Film) -> None:
    tracks = oncoming.tracks(left_out=[10, 11])
    assert not np.isin(tracks.scan_index, [10, 11]).any()
    assert 7.7 < np.median(main_track(tracks).speed_m_s) < 8.3


def test_empty_scans_one_scan_and_none(oncoming: Film) -> None:
    first = oncoming.scans[0]
    empty = [s.take(slice(0, 0)) for s in oncoming.scans[:5]]
    nothing = [s.take(slice(0, 0)) for s in oncoming.labels[:5]]
    T = oncoming.T_world_lidar
    assert len(Film(empty, nothing, T[:5], oncoming.T_base_lidar, []).tracks()) == 0
    assert len(Film([first], oncoming.labels[:1], T[:1], oncoming.T_base_lidar, []).tracks()) == 0
    assert len(Film([], [], T[:0], oncoming.T_base_lidar, []).tracks()) == 0


def test_an_empty_scan_in_between_and_points_that_are_not_finite(oncoming: Film) -> None:
    scans, labels = list(oncoming.scans), list(oncoming.labels)
    scans[20], labels[20] = scans[20].take(slice(0, 0)), labels[20].take(slice(0, 0))
    broken = scans[21].x_m.copy()
    broken[::7] = np.nan
    scans[21] = type(scans[21])(**{**scans[21].__dict__, "x_m": broken})
    tracks = Film(scans, labels, oncoming.T_world_lidar, oncoming.T_base_lidar, oncoming.boxes).tracks()
    assert 0.95 < oncoming.covered(tracks, 0) <= 1.0


def test_the_size_of_a_car_is_that_of_the_box(oncoming: Film) -> None:
    car = main_track(oncoming.tracks())
    middle = car.T_odom_object[:, 0, 3]
    true = 55.0 - 8.0 * 0.1 * car.scan_index
    assert np.median(np.abs(middle - true)) < 0.3
    assert len(np.unique(car.length_m)) == 1
    assert CAR[1] - 0.5 < car.width_m[0] < CAR[1] + 0.3
