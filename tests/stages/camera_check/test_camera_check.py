"""The targetless check: turned cameras are found, untouched ones are left in peace, and what cannot be told is not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scanloom.schemas.cameras import CameraAgreement, CameraModel, Cameras, Image, Images
from scanloom.schemas.product import Parts
from scanloom.schemas.scans import Deskewed, Labels, PointClass
from scanloom.stages.camera_check import Settings, camera_check
from scanloom.stages.camera_check.distance import BINS, nid, ranks
from scanloom.stages.camera_check.search import Fit
from scanloom.stages.camera_check.stage import LEAST_IMAGES, judged
from scanloom.stages.camera_check.views import BEHIND_M, smaller, visible
from scanloom.stages.geometry.camera import project
from tests.stages.camera_check.street import Recorded, Street, mounted, record

SETTINGS = Settings(points=1500)


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
    assert found.verdict == "agrees" and found.images == 16 and found.points > 12_000
    assert found.turned_deg < 0.2 and all(0.001 < std < 0.12 for std in found.std_deg)
    assert found.nid_best <= found.nid + 1e-6 < 1.0
    assert found.remark.startswith("Camera front stands where")
    assert check(recorded) == found


@pytest.mark.parametrize("turn", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (-0.8, 1.2, 0.4)])
def test_a_turned_camera_is_found_and_measured(turn: tuple[float, float, float], recorded: Recorded) -> None:
    found = check(recorded, turn)
    assert found.verdict == "moved" and "calibrate it again" in found.remark
    np.testing.assert_allclose(found.offset_deg, turn, atol=0.2)
    assert found.nid_best < found.nid


def test_a_turn_below_the_limit_is_no_move(recorded: Recorded) -> None:
    assert check(recorded, (0.1, 0.0, 0.0)).verdict == "agrees"
    assert check(recorded, (0.0, 0.35, 0.0)).verdict == "moved"
    assert check(recorded, (0.0, 0.35, 0.0), Settings(points=1500, moved_deg=0.8)).verdict == "agrees"


def noise(image: Image, rng: np.random.Generator) -> Image:
    pixels = cv2.GaussianBlur(rng.integers(0, 256, (300, 480)).astype(np.uint8), (0, 0), 6)
    return replace(image, data=np.asarray(cv2.imencode(".png", pixels)[1], np.uint8).reshape(-1))


def test_images_of_something_else_tell_nothing(recorded: Recorded) -> None:
    rng = np.random.default_rng(0)
    strange = [Images([noise(image, rng) for image in part]) for part in recorded.images]
    where = [((("session", "a"), ("footage", f"{n:04d}")), part) for n, part in enumerate(strange)]
    found = check(replace(recorded, images=Parts(where)))
    assert found.verdict == "unknown" and "cannot be told" in found.remark


def test_too_few_images_are_not_judged(recorded: Recorded) -> None:
    enough, few = (
        check(recorded, settings=Settings(images=n, points=1500)) for n in (LEAST_IMAGES, LEAST_IMAGES - 1)
    )
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


def fit(turn_deg: float, std_deg: float, gain_std: float) -> Fit:
    return Fit(
        np.radians([turn_deg, 0.0, 0.0]), np.radians([std_deg, 0.01, 0.01]), 0.98, 0.97, gain_std, 9999
    )


@pytest.mark.parametrize(
    ("turn", "std", "gain", "verdict"),
    [
        (0.26, 0.05, 9.0, "moved"), (0.24, 0.05, 9.0, "agrees"), (0.5, 0.05, 2.9, "unknown"), (0.5, 0.05, 3.1, "moved"),
        (0.5, 0.17, 9.0, "unknown"), (0.5, 0.16, 9.0, "moved"), (0.1, 0.119, 0.0, "agrees"), (0.1, 0.121, 0.0, "unknown"),
    ],
)  # fmt: skip
def test_limits_of_the_verdict(turn: float, std: float, gain: float, verdict: str) -> None:
    assert judged(Settings(), fit(turn, std, gain)) == verdict


def test_distance_of_what_is_told_and_of_what_is_not() -> None:
    same = np.diag(np.arange(1.0, BINS + 1))
    assert nid(same) == pytest.approx(0.0, abs=1e-12)
    assert nid(same[:, ::-1]) == pytest.approx(0.0, abs=1e-12)
    assert nid(np.outer(np.arange(1.0, BINS + 1), np.ones(BINS))) == pytest.approx(1.0, abs=1e-12)
    # two by two with a share e of errors: H(X) = H(Y) = 1 bit, H(X, Y) = 1 bit + h(e)
    errors = np.zeros((BINS, BINS))
    errors[:2, :2] = [[0.45, 0.05], [0.05, 0.45]]
    h = -(0.1 * np.log2(0.1) + 0.9 * np.log2(0.9))
    assert nid(errors) == pytest.approx(2 - 2 / (1 + h))


def test_ranks_are_even_at_every_range() -> None:
    rng = np.random.default_rng(1)
    far = rng.uniform(2, 60, 60_000)
    strength = (rng.random(60_000) * np.exp(-far / 20)).astype(np.float32)
    rank = ranks(strength, far)
    for near, beyond in ((2, 12), (40, 60)):
        share = np.bincount(rank[(far > near) & (far < beyond)], minlength=BINS) * BINS
        assert 0.7 < share.min() / ((far > near) & (far < beyond)).sum() < 1.0
    assert set(ranks(np.ones(100, np.float32), far[:100])) == {BINS // 2}
    assert len(ranks(np.empty(0, np.float32), np.empty(0))) == 0


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
