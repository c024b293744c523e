"""The targetless check: turned cameras are found, untouched ones are left in peace, and what cannot be told is not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from scanloom.schemas.cameras import CameraAgreement, CameraModel, Cameras, Image, Images
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, DeskewedScan, Labels, PointClass
from scanloom.stages.camera_check import Settings, camera_check, far, search
from scanloom.stages.camera_check.distance import BINS, F4, nid
from scanloom.stages.camera_check.search import REACHES_RAD, Fit
from scanloom.stages.camera_check.stage import LEAST_IMAGES, judged
from scanloom.stages.camera_check.steps import Kind, steps
from scanloom.stages.camera_check.views import (
    BEHIND_M,
    CLEAR_M,
    LEAST_CLEAR,
    View,
    _balanced,
    smaller,
    visible,
)
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8
from tests.stages.camera_check.street import Recorded, Street, mounted, record

SETTINGS = Settings()


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record(Street(3), images=16)


def check(
    recorded: Recorded, turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0), settings: Settings = SETTINGS
) -> CameraAgreement:
    given = Cameras(cameras=(mounted(turn_deg),))
    (found,) = camera_check(
        settings, recorded.images, given, recorded.deskewed, recorded.labels, recorded.odometry
    ).cameras
    return found


def test_an_untouched_camera_agrees(recorded: Recorded) -> None:
    found = check(recorded)
    assert found.verdict == "agrees" and found.images == 16 and 12_000 < found.points < 16 * SETTINGS.points
    assert found.turned_deg < 0.15 and all(0.04 <= std < 0.1 for std in found.std_deg)
    assert found.nid_best <= found.nid + 1e-6 < 1.0
    assert found.remark.startswith("Camera front stands where")
    assert check(recorded) == found


def test_rows_of_a_rolling_shutter_are_compared_where_they_were_taken() -> None:
    rolling = record(Street(3), images=16, readout_s=0.08)
    found = {}
    for readout_s in (0.0, 0.08):
        camera = mounted().model_copy(update={"readout_s": readout_s})
        (found[readout_s],) = camera_check(
            SETTINGS, rolling.images, Cameras(cameras=(camera,)), rolling.deskewed, rolling.labels, rolling.odometry
        ).cameras  # fmt: skip
    assert found[0.08].verdict == "agrees" and found[0.08].turned_deg < 0.15
    assert found[0.08].nid < found[0.0].nid - 0.004


@pytest.mark.parametrize("turn", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (-0.8, 1.2, 0.4)])
def test_a_turned_camera_is_found_and_measured(turn: tuple[float, float, float], recorded: Recorded) -> None:
    found = check(recorded, turn)
    assert found.verdict == "moved" and "calibrate it again" in found.remark
    np.testing.assert_allclose(found.offset_deg, turn, atol=0.12)
    assert found.nid_best < found.nid


def test_halves_are_searched_from_where_all_images_fit(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A half that its own search leads astray is no reason to doubt: where all fit it fits better."""
    descended, lost = search._descended, np.radians([0.0, 0.9, 0.0])

    def astray(views: list[View], grey: F4, turn: F8, reaches_rad: tuple[float, ...] = REACHES_RAD) -> F8:
        half_alone = len(views) < 16 and reaches_rad is REACHES_RAD
        return lost if half_alone else descended(views, grey, turn, reaches_rad)

    monkeypatch.setattr(search, "_descended", astray)
    found = check(recorded, (0.5, 0.0, 0.0))
    assert found.verdict == "moved" and max(found.std_deg) < 0.1


def test_the_best_of_the_grid_is_followed_though_it_is_next_to_none(monkeypatch: pytest.MonkeyPatch) -> None:
    followed = []

    def here(_: list[View], __: F4, turn: F8, ___: tuple[float, ...] = REACHES_RAD) -> F8:
        followed.append(tuple(turn))
        return turn

    monkeypatch.setattr(search, "_descended", here)
    monkeypatch.setattr(search, "nid", lambda joint: joint)
    monkeypatch.setattr(
        search, "scene", lambda *_, **__: SimpleNamespace(histograms=lambda turn: np.array([-turn[1]]))
    )
    step = np.array([0.0, np.radians(0.4), 0.0])
    np.testing.assert_array_equal(search._found([], np.empty(0, np.float32), step), step)
    assert followed == [(0.0, 0.0, 0.0), tuple(step)]
    np.testing.assert_array_equal(search._found([], np.empty(0, np.float32), np.zeros(3)), np.zeros(3))
    assert len(followed) == 3


@pytest.mark.parametrize(("far", "left"), [(LEAST_CLEAR, False), (LEAST_CLEAR - 1, True)])
def test_near_steps_are_left_out_where_far_ones_are_enough(far: int, left: bool) -> None:
    kind = np.array([Kind.EVEN, Kind.MARK] * 50 + [Kind.EVEN, Kind.EDGE] * far, np.int64)
    range_m = np.array([CLEAR_M] * 100 + [CLEAR_M + 0.01] * 2 * far)
    rows = _balanced(kind, range_m, 1000)
    assert bool((rows < 100).any()) is left
    np.testing.assert_array_equal(np.bincount(kind[rows] == Kind.EVEN), [far + 50 * left] * 2)


def test_a_turn_below_the_limit_is_no_move(recorded: Recorded) -> None:
    assert check(recorded, (0.1, 0.0, 0.0)).verdict == "agrees"
    assert check(recorded, (0.0, 0.35, 0.0)).verdict == "moved"
    assert check(recorded, (0.0, 0.35, 0.0), Settings(moved_deg=0.8)).verdict == "agrees"


def test_a_turn_just_below_the_limit_is_not_told_as_none(recorded: Recorded) -> None:
    limit_deg = check(recorded, (0.0, 0.2, 0.0)).turned_deg + 0.01
    found = check(recorded, (0.0, 0.2, 0.0), Settings(moved_deg=limit_deg))
    assert found.verdict == "unknown" and "too near to the limit" in found.remark


def noise(image: Image, rng: np.random.Generator) -> Image:
    pixels = cv2.GaussianBlur(rng.integers(0, 256, (300, 480)).astype(np.uint8), (0, 0), 6)
    return replace(image, data=np.asarray(cv2.imencode(".png", pixels)[1], np.uint8).reshape(-1))


@pytest.mark.parametrize("turn", [(1.7, -1.2, 1.9), (2.4, 0.3, -0.2), (-3.0, 4.5, 5.0), (0.0, -9.5, 0.0)])
def test_a_camera_that_was_knocked_aside_is_found(
    turn: tuple[float, float, float], recorded: Recorded
) -> None:
    found = check(recorded, turn)
    assert found.verdict == "moved" and found.images == 16
    np.testing.assert_allclose(found.offset_deg, turn, atol=0.15)
    assert max(found.std_deg) < 0.12 and found.nid_best < found.nid - 0.01


@pytest.mark.parametrize("turn", [(0.0, 16.0, 0.0), (9.0, 20.0, -25.0), (0.0, 90.0, 0.0)])
def test_a_turn_that_is_too_large_is_not_told_as_another(
    turn: tuple[float, float, float], recorded: Recorded
) -> None:
    found = check(recorded, turn)
    assert found.verdict == "unknown" and "cannot be told" in found.remark


def test_images_of_something_else_tell_nothing(recorded: Recorded) -> None:
    rng = np.random.default_rng(2)
    strange = [Images([noise(image, rng) for image in part]) for part in recorded.images]
    where = [((("session", "a"), ("footage", f"{n:04d}")), part) for n, part in enumerate(strange)]
    found = check(replace(recorded, images=Parts(where)))
    assert found.verdict == "unknown" and "cannot be told from 16 images: " in found.remark


def test_too_few_images_are_not_judged(recorded: Recorded) -> None:
    enough, few = (check(recorded, settings=Settings(images=n)) for n in (LEAST_IMAGES, LEAST_IMAGES - 1))
    assert enough.images == LEAST_IMAGES and np.isfinite(enough.nid)
    assert few.verdict == "unknown" and np.isnan(few.nid) and few.images == LEAST_IMAGES - 1


def test_what_moves_is_not_compared(recorded: Recorded) -> None:
    """All points of the second half of the session are of things that move."""
    labels = list(recorded.labels)
    moving = Labels(
        [replace(item, class_=np.full(len(item), PointClass.DYNAMIC, np.uint8)) for item in labels[1]]
    )
    where = [((("session", "a"), ("chunk", f"{n:04d}")), part) for n, part in enumerate((labels[0], moving))]
    assert check(replace(recorded, labels=Parts(where))).images == 8


def test_bridged_stretches_are_left_out(recorded: Recorded) -> None:
    path = recorded.odometry
    bridged = replace(path, reliable=np.arange(len(path)) >= len(path) // 2)
    assert check(replace(recorded, odometry=bridged)).images <= 8
    broken = replace(path, segment=np.arange(len(path), dtype=np.int32))
    assert check(replace(recorded, odometry=broken)).images == 0


def test_damaged_images_are_passed_over(recorded: Recorded) -> None:
    parts = [list(part) for part in recorded.images]
    parts[0][2] = replace(parts[0][2], data=parts[0][2].data[:100])
    where = [((("session", "a"), ("footage", f"{n:04d}")), Images(part)) for n, part in enumerate(parts)]
    assert check(replace(recorded, images=Parts(where))).images == 15


@pytest.mark.parametrize("given", ["no camera", "no place", "no image", "not asked"])
def test_where_there_is_nothing_nothing_is_read(given: str, recorded: Recorded) -> None:
    unread: Parts[Deskewed] = Parts([((), None)], load=lambda _: pytest.fail("was read"))
    camera = mounted().model_copy(update={"T_lidar_camera": None} if given == "no place" else {})
    cameras = Cameras(cameras=() if given == "no camera" else (camera,))
    images: Parts[Images] = Parts([]) if given == "no image" else recorded.images
    settings = Settings(images=0) if given == "not asked" else SETTINGS
    assert camera_check(settings, images, cameras, unread, unread, recorded.odometry).cameras == ()  # type: ignore[arg-type]


# --- its parts -------------------------------------------------------------------------------------------------------


def fit(
    turn_deg: float, std_deg: float, gain_std: float, *, nid_best: float = 0.97, held: bool = False
) -> Fit:
    return Fit(
        np.radians([turn_deg, 0.0, 0.0]), np.radians([std_deg, 0.01, 0.01]), 0.98, nid_best, gain_std, 9999, held
    )  # fmt: skip


@pytest.mark.parametrize(
    ("turn", "std", "gain", "verdict"),
    [
        (0.26, 0.05, 9.0, "moved"), (0.24, 0.05, 9.0, "unknown"), (0.19, 0.05, 9.0, "agrees"), (0.5, 0.05, 1.4, "unknown"), (0.5, 0.05, 1.6, "moved"),
        (0.5, 0.17, 9.0, "unknown"), (0.5, 0.16, 9.0, "moved"), (0.1, 0.119, 0.0, "agrees"), (0.1, 0.121, 0.0, "unknown"),
    ],
)  # fmt: skip
def test_limits_of_the_verdict(turn: float, std: float, gain: float, verdict: str) -> None:
    assert judged(Settings(), fit(turn, std, gain)) == verdict


@pytest.mark.parametrize(
    ("turn", "std", "nid_best", "held", "verdict"),
    [
        (1.01, 0.119, 0.97, False, "moved"), (1.01, 0.121, 0.97, False, "unknown"), (0.99, 0.121, 0.97, False, "moved"),
        (1.01, 0.121, 0.9499, False, "moved"), (1.01, 0.121, 0.9501, False, "unknown"),
        (1.85, 0.05, 0.9, True, "unknown"), (1.85, 0.05, 0.9, False, "moved"),
    ],
)  # fmt: skip
def test_large_turns_are_known_well_or_tell_much_more(
    turn: float, std: float, nid_best: float, held: bool, verdict: str
) -> None:
    assert judged(Settings(), fit(turn, std, 9.0, nid_best=nid_best, held=held)) == verdict


NEAR = fit(1.9, 0.05, 2.0, nid_best=0.96, held=True)
IN_DOUBT = fit(0.2, 0.2, 0.0, nid_best=0.97)


@pytest.mark.parametrize(
    ("near", "nid_best", "std_deg", "held", "taken"),
    [
        (IN_DOUBT, 0.9699, 0.1, False, True), (IN_DOUBT, 0.9701, 0.1, False, False),
        (NEAR, 0.9639, 0.1, False, True), (NEAR, 0.9641, 0.1, False, False),
        (IN_DOUBT, 0.9, 0.119, False, True), (IN_DOUBT, 0.9, 0.121, False, False), (IN_DOUBT, 0.9, 0.1, True, False),
    ],
)  # fmt: skip
def test_another_fit_is_taken_where_it_is_better_and_sharp(
    near: Fit, nid_best: float, std_deg: float, held: bool, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = np.radians([4.0, 0.0, -2.0])
    monkeypatch.setattr(far, "_starts", lambda _: [start])
    monkeypatch.setattr(far, "comparable", lambda _: far.LEAST_STEPS)
    there = replace(fit(0.0, std_deg, 9.0, nid_best=nid_best, held=held), std_rad=np.radians([std_deg] * 3))
    monkeypatch.setattr(far, "best_turn", lambda *_: there)
    found = far.farther([], near, lambda _: [], np.radians(0.12))
    if taken:
        np.testing.assert_allclose(found.turn_rad, near.turn_rad if near.held else start, atol=1e-12)
    else:
        assert found is near


@pytest.mark.parametrize(("ends", "looked"), [((True, False), 2), ((True,) * 9, far.FOLLOWED), ((False,), 1)])
def test_a_search_that_ends_at_its_limit_is_followed(
    ends: tuple[bool, ...], looked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[F8] = []
    found = iter(fit(1.85, 0.05, 9.0, nid_best=0.9, held=held) for held in ends)
    monkeypatch.setattr(far, "comparable", lambda _: far.LEAST_STEPS)
    monkeypatch.setattr(far, "best_turn", lambda *_: next(found))
    last = far._followed(np.zeros(3), [], lambda turn: seen.append(turn) or [])
    assert last is not None and last.held is ends[looked - 1] and len(seen) == looked
    np.testing.assert_allclose(np.degrees(last.turn_rad), [1.85 * looked, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(("steps", "looked"), [(far.LEAST_STEPS, far.FOLLOWED), (far.LEAST_STEPS - 1, 0)])
def test_where_too_little_is_left_in_the_image_nothing_is_searched(
    steps: int, looked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[object] = []
    monkeypatch.setattr(far, "_starts", lambda _: [np.radians([4.0, 0.0, 0.0])])
    monkeypatch.setattr(far, "comparable", lambda _: steps)
    monkeypatch.setattr(far, "best_turn", lambda *views: seen.append(views) or NEAR)
    assert far.farther([], IN_DOUBT, lambda _: [], np.radians(0.12)) is IN_DOUBT
    assert len(seen) == looked


def test_a_narrow_lens_has_no_grid() -> None:
    """At the largest turns everything is out of its image; a wide one keeps what is near its middle."""
    rng = np.random.default_rng(4)
    count = far.EVERY * far.LEAST_STEPS
    places = np.column_stack((rng.uniform(-0.5, 0.5, (count, 2)), np.full(count, 10.0)))
    kind = rng.integers(0, 2, count)
    for fx_px, narrow in ((290.0, False), (2900.0, True)):
        model = CameraModel(
            lens="pinhole", width_px=480, height_px=300, fx_px=fx_px, fy_px=fx_px, cx_px=240, cy_px=150
        )
        one = View(0, np.zeros((300, 480), np.uint8), model, places, places, kind, kind)
        assert (
            far._staying([one], np.radians([[10.0, 10, 10], [-10, -10, -10]]))[1].kind.size == 0
        ) is narrow
        assert bool(far._starts([one] * 8)) is not narrow


def joint(*along: np.ndarray) -> np.ndarray:
    """Histograms (across, kind, difference) of two directions."""
    return np.stack([np.asarray(each, float) for each in along])


def test_distance_of_what_is_told_and_of_what_is_not() -> None:
    nothing, same = np.zeros((4, BINS)), np.zeros((4, BINS))
    same[np.arange(4), [1, 5, 7, 11]] = (4.0, 3.0, 2.0, 9.0)
    assert nid(joint(same, nothing)) == pytest.approx(0.0, abs=1e-12)
    assert nid(joint(same[::-1], nothing)) == pytest.approx(0.0, abs=1e-12)
    unrelated = np.outer([1.0, 2.0, 3.0, 4.0], np.arange(1.0, BINS + 1))
    assert nid(joint(unrelated, unrelated[::-1])) == pytest.approx(1.0, abs=1e-12)
    # two by two with a share e of errors: H(X) = H(Y) = 1 bit, H(X, Y) = 1 bit + h(e)
    errors = np.zeros((4, BINS))
    errors[:2, :2] = [[45, 5], [5, 45]]
    h = -(0.1 * np.log2(0.1) + 0.9 * np.log2(0.9))
    assert nid(joint(errors, errors)) == pytest.approx(2 - 2 / (1 + h))
    # half of the steps tell all with one bit each, half tell nothing with one bit each
    clear, dull = np.zeros((4, BINS)), np.zeros((4, BINS))
    clear[[0, 1], [0, 1]], dull[:2, :2] = 50.0, 25.0
    assert nid(joint(clear, dull)) == pytest.approx(2 - 4 / 3)


# --- steps of a scan -------------------------------------------------------------------------------------------------

BEAMS_DEG, STEP_DEG, POST_Y, MARK_Y = np.linspace(-15, 15, 31), 0.5, (-0.6, 0.6), -4.0


def scanned(wall_up_m: float = 3.0) -> DeskewedScan:
    """Ground 2 m below, a wall at x = 15 m whose right part is brighter, and a board at x = 6 m before it."""
    azimuth, elevation = np.radians(np.meshgrid(np.arange(-180, 180, STEP_DEG), BEAMS_DEG)).reshape(2, -1)
    d = np.column_stack(
        (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(d[:, 2] < 0, -2.0 / d[:, 2], np.inf)
        wall = np.where(d[:, 0] > 0.5, 15.0 / d[:, 0], np.inf)
        board = np.where(d[:, 0] > 0.5, 6.0 / d[:, 0], np.inf)
        left = d[:, 1] / d[:, 0]
        up = d[:, 2] / d[:, 0]
    board[~((6.0 * left > POST_Y[0]) & (6.0 * left < POST_Y[1])) | (6.0 * up > 1.0)] = np.inf
    wall[15.0 * up > wall_up_m] = np.inf
    far = np.minimum(np.minimum(ground, wall), board)
    seen = far < 30.0
    light = np.where(far == wall, np.where(15.0 * left < MARK_Y, 40.0, 10.0), 20.0)
    noise = np.random.default_rng(1).normal(1.0, 0.02, len(far))
    x, y, z = (far[seen, None] * d[seen]).astype(np.float32).T.copy()
    intensity = (light * noise)[seen].astype(np.float32)
    return DeskewedScan(x_m=x, y_m=y, z_m=z, intensity=intensity, reference_ns=0, scan_index=0)


def test_steps_are_where_something_changes() -> None:
    scan = scanned()
    found = steps(scan, np.ones(len(scan.x_m), bool))
    kind, side = found.kind, found.across == 0
    on_board = np.abs(found.near[:, 0] - 6.0) < 0.01
    # every beam that meets the board ends at its right and at its left, and each of its columns at the top
    edges = on_board & (kind == Kind.EDGE)
    beams = int(((BEAMS_DEG > -18.0) & (np.tan(np.radians(BEAMS_DEG)) * 6.0 < 1.0)).sum())
    assert abs(int((edges & side).sum()) - 2 * beams) <= 2
    columns = int(2 * np.degrees(np.arctan(0.1)) / STEP_DEG)
    assert abs(int((edges & ~side).sum()) - columns) <= 3
    assert np.abs(np.abs(found.near[edges & side, 1]) - 0.6).max() < 6.0 * np.radians(STEP_DEG)
    assert np.abs(found.near[edges & side, 1]).max() < 0.6
    assert np.mean(np.abs(found.beside[edges & side, 1]) > 0.6) > 0.9
    # where the wall stands on the ground the reflectance changes, too
    marks = (kind == Kind.MARK) & (found.near[:, 2] > -1.5) & (np.abs(found.near[:, 0] - 15.0) < 0.01)
    assert 10 <= int((marks & side).sum()) <= 31
    np.testing.assert_allclose(found.near[marks & side, 1], MARK_Y, atol=0.2)
    # the ground goes on, however flat it is seen
    on_ground = found.near[:, 2] < -1.99
    ground = kind[on_ground & (np.hypot(*found.near[:, :2].T) < 12.0)]
    assert np.mean(ground == Kind.EVEN) > 0.97 and len(ground) > 2000
    assert np.mean(kind == Kind.EVEN) > 0.8


def test_beside_is_what_the_next_ray_met_or_as_far_away_where_a_surface_ends() -> None:
    scan = scanned()
    found = steps(scan, np.ones(len(scan.x_m), bool))
    ends = found.kind == Kind.EDGE
    far = np.linalg.norm(found.near, axis=1)
    turn = np.degrees(
        np.arccos((found.near * found.beside).sum(axis=1) / far / np.linalg.norm(found.beside, axis=1))
    )
    np.testing.assert_allclose(np.linalg.norm(found.beside, axis=1)[ends], far[ends], rtol=1e-6)
    # from row to row the ground is met farther off, but no higher: a camera beside the LiDAR must look there
    ground = (found.near[:, 2] < -1.99) & (found.kind == Kind.EVEN)
    np.testing.assert_allclose(found.beside[ground, 2], found.near[ground, 2], atol=0.01)
    # a cell holds the nearer of two points where there are fewer columns than points
    for across, step in ((0, STEP_DEG), (1, 1.0)):
        assert 0.9 * step < np.quantile(turn[found.across == across], 0.1)
        assert np.quantile(turn[found.across == across], 0.9) < 1.1 * step


@pytest.mark.parametrize(("up", "opens"), [(1.5, True), (9.0, False)])
def test_a_wall_ends_before_nothing_at_its_top(up: float, opens: bool) -> None:
    scan = scanned(up)
    found = steps(scan, np.ones(len(scan.x_m), bool))
    on_wall = np.abs(found.near[:, 0] - 15.0) < 0.01
    top = found.near[(found.kind == Kind.OPEN) & on_wall & (found.across == 1)]
    if opens:
        assert len(top) > 60 and 1.5 - 0.6 < top[:, 2].min() <= top[:, 2].max() <= 1.5
    else:
        assert len(top) < 10  # beyond the highest beam nothing is known


def test_steps_use_only_what_may_be_used() -> None:
    scan = scanned()
    left = scan.y_m > 0
    found = steps(scan, left)
    assert len(found.kind) > 3000 and found.near[:, 1].min() > 0
    assert not len(steps(scan, np.zeros(len(scan.x_m), bool)).kind)


MODEL = CameraModel(
    lens="pinhole", width_px=1290, height_px=970, fx_px=900, fy_px=900, cx_px=644.5, cy_px=484.5
)


def test_what_stands_behind_is_hidden() -> None:
    u = np.linspace(-0.02, 0.02, 9)
    wall = np.column_stack((u * 10, 0 * u, np.full(9, 10.0)))
    beyond = wall * 1.05 + np.array([0, 0, BEHIND_M])
    before, behind = beyond - np.array([0, 0, 0.05]), beyond + np.array([0, 0, 0.05])
    rows = visible(MODEL, np.concatenate((wall, before, behind, [[0, 5.0, 10.0]])))
    np.testing.assert_array_equal(rows, [*range(18), 27])
    assert len(visible(MODEL, np.array([[0, 0, 1.9], [0, 0, -5.0], [0, 0, 61.0]]))) == 0


def test_a_smaller_image_has_its_points_at_the_same_places() -> None:
    pixels = np.zeros((970, 1290), np.uint8)
    pixels[400:402, 300:302] = 200
    small, model = smaller(pixels, MODEL)
    assert small.shape == (485, 645) and (model.width_px, model.height_px) == (645, 485)
    assert small[200, 150] == 200
    point = np.array([[(300.5 - MODEL.cx_px) / 900, (400.5 - MODEL.cy_px) / 900, 1.0]])
    np.testing.assert_allclose(project(model, point)[0], [[150.0, 200.0]], atol=1e-9)
    assert smaller(pixels[:480, :640], MODEL)[1] is MODEL
