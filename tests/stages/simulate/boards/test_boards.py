"""Simulated calibration sessions: the same again, geometry that holds, and what goes wrong when asked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.highlevel import AnyReader

from scanloom.stages.geometry.se3 import inverse, transform
from scanloom.stages.simulate.boards import (
    BoardSession,
    BoardSettings,
    Timing,
    board_session,
    write_log,
    write_session,
)
from scanloom.stages.simulate.boards.log import duration_s, moment

SMALL: dict[str, Any] = {"width_px": 640, "height_px": 480, "cameras": 2, "placements": 4, "columns": 900}


def _session(seed: int = 4, **changes: Any) -> BoardSession:
    return board_session(seed, BoardSettings.model_validate({**SMALL, **changes}))


@pytest.fixture(scope="module")
def session() -> BoardSession:
    return _session()


def _seen_wholly(session: BoardSession) -> list[tuple[str, int]]:
    return [
        (c.name, k)
        for c in session.cameras
        for k in range(len(session.stands))
        if session.true_corners(c.name, k)[1].all()
    ]


def test_every_camera_sees_boards(session: BoardSession) -> None:
    pairs = _seen_wholly(session)
    assert {camera for camera, _ in pairs} == {"front", "left"}
    assert {k for _, k in pairs} == {0, 1, 2, 3}


def test_corners_of_images_are_where_truth_says(session: BoardSession) -> None:
    found_any = 0
    for camera, k in _seen_wholly(session)[:4]:
        grey = cv2.cvtColor(session.image(camera, k), cv2.COLOR_RGB2GRAY)
        found, corners = cv2.findChessboardCornersSB(grey, session.board.inner_corners)
        if not found:
            continue
        found_any += 1
        truth, _ = session.true_corners(camera, k)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        corners = cv2.cornerSubPix(grey, corners, (3, 3), (-1, -1), stop).reshape(-1, 2)
        gaps = np.linalg.norm(corners[:, None] - truth[None], axis=2)
        assert sorted(gaps.argmin(axis=1).tolist()) == list(range(len(truth)))
        assert 0.005 < np.sqrt((gaps.min(axis=1) ** 2).mean()) < 0.15
        assert gaps.min(axis=1).max() < 0.3
    assert found_any >= 3


def test_points_lie_on_the_board_with_the_noise_asked_for() -> None:
    quiet = {"range_offset_m": 0.0, "beam_range_error_m": 0.0, "beam_angle_error_deg": 0.0, "dark_m": 0.0}
    session = _session(**quiet)
    for k, stand in enumerate(session.stands):
        cloud = session.cloud(k)
        at = transform(inverse(stand.T_lidar_board), cloud.points_m.astype(float))
        half = np.asarray(session.board.board_m) / 2 - 0.04
        on = (np.abs(at[:, :2]) < half).all(axis=1) & (np.abs(at[:, 2]) < 0.15)
        towards = cloud.points_m[on] / np.linalg.norm(cloud.points_m[on], axis=1, keepdims=True)
        ranges = at[on, 2] / -(towards @ stand.T_lidar_board[:3, 2])
        assert on.sum() > 60
        assert 0.017 < ranges.std() < 0.023
        assert abs(ranges.mean()) < 4 * 0.02 / np.sqrt(on.sum())
        # Far from edges of squares print and paper are well apart.
        dark = session.board.dark(at[on, 0], at[on, 1])
        square = np.abs(at[on, :2] / session.board.square_m % 1 - (0.0, 0.5))
        clear = ((square > 0.25) & (square < 0.75)).all(axis=1)
        if (clear & dark).sum() > 3 and (clear & ~dark).sum() > 3:
            assert np.median(cloud.intensity[on][clear & ~dark]) > 4 * np.median(
                cloud.intensity[on][clear & dark]
            )


def test_errors_of_beams_are_as_asked_for() -> None:
    session = _session(range_offset_m=0.0, beam_range_error_m=0.05, beams=64)
    assert 0.035 < session.scanner.beam_m.std() < 0.065
    assert not _session(beam_range_error_m=0.0).scanner.beam_m.any()


def test_same_seed_same_session(session: BoardSession, tmp_path: Path) -> None:
    again = _session()
    assert json.dumps(again.truth()) == json.dumps(session.truth())
    assert again.cloud(2).points_m.tobytes() == session.cloud(2).points_m.tobytes()
    assert again.image("left", 1).tobytes() == session.image("left", 1).tobytes()
    for camera, k in _seen_wholly(session):
        corners = session.corners(camera, k)
        assert corners is not None
        assert np.array_equal(corners, again.corners(camera, k))
    assert json.dumps(_session(5).truth()) != json.dumps(session.truth())


def test_corners_without_images_have_the_noise_asked_for() -> None:
    session = _session(placements=40, corner_noise_px=0.5)
    off = [
        corners - session.true_corners(c.name, k)[0]
        for c in session.cameras
        for k in range(40)
        if (corners := session.corners(c.name, k)) is not None
    ]
    assert 0.46 < np.concatenate(off).std() < 0.54


def test_what_goes_wrong_goes_wrong() -> None:
    bad = ("moved", "glare", "wrong board", "no board")
    session = _session(bad=bad, placements=6)
    stands = {stand.bad: (k, stand) for k, stand in enumerate(session.stands)}
    assert set(stands) == {*bad, None}
    assert sum(stand.bad is None for stand in session.stands) == 2
    k, stand = stands["moved"]
    assert not np.allclose(stand.T_lidar_board, stand.T_lidar_seen)
    for name in ("glare", "wrong board", "no board"):
        k, stand = stands[name]
        assert np.array_equal(stand.T_lidar_board, stand.T_lidar_seen)
        assert all(session.corners(c.name, k) is None for c in session.cameras)
    wrong = stands["wrong board"][1].board
    assert wrong.inner_corners != session.board.inner_corners
    k = stands["no board"][0]
    other = stands[None][0]
    at = transform(inverse(session.stands[k].T_lidar_board), session.cloud(k).points_m.astype(float))
    there = transform(
        inverse(session.stands[other].T_lidar_board), session.cloud(other).points_m.astype(float)
    )
    assert (np.linalg.norm(at, axis=1) < 0.25).sum() < 5 < (np.linalg.norm(there, axis=1) < 0.25).sum()


def test_swapped_cameras_have_each_others_images(session: BoardSession) -> None:
    swapped = _session(swapped=True)
    assert np.array_equal(swapped.true_corners("left", 0)[0], session.true_corners("front", 0)[0])
    assert np.array_equal(swapped.true_corners("front", 0)[0], session.true_corners("left", 0)[0])
    assert not np.array_equal(session.true_corners("front", 0)[0], session.true_corners("left", 0)[0])


def test_a_folder_holds_a_session_and_no_truth(tmp_path: Path) -> None:
    session = _session(placements=1, width_px=320, height_px=240)
    write_session(session, tmp_path / "rig", tmp_path / "truth.json")
    files = sorted(p.relative_to(tmp_path / "rig").as_posix() for p in (tmp_path / "rig").rglob("*.*"))
    assert files == [
        "board.yaml", "camera_info/front.yaml", "camera_info/left.yaml", "clouds/pose1.pcd", "images/front/pose1.png",
        "images/left/pose1.png",
    ]  # fmt: skip
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert [c["name"] for c in truth["cameras"]] == ["front", "left"]
    header, _, body = (tmp_path / "rig/clouds/pose1.pcd").read_bytes().partition(b"DATA binary\n")
    assert f"POINTS {len(body) // 18}\n".encode() in header
    image = cv2.imread(str(tmp_path / "rig/images/front/pose1.png"))
    assert np.array_equal(image[..., ::-1], session.image("front", 0))


@pytest.mark.parametrize(
    "changes",
    [
        {"cameras": 4},
        {"cameras": 0},
        {"placements": 0},
        {"placements": 1, "bad": ("glare", "moved")},
        {"bad": ("rain",)},
        {"cameras": 1, "swapped": True},
        {"nearest_m": 3.0, "farthest_m": 2.9},
        {"square_m": 0.12, "board_m": (0.6, 0.6)},
        {"inner_corners": (1, 5)},
        {"beams": 48},
    ],
)
def test_impossible_sessions_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        BoardSettings.model_validate({**SMALL, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {"cameras": 3},
        {"cameras": 1},
        {"placements": 1},
        {"placements": 2, "bad": ("glare", "moved")},
        {"cameras": 2, "swapped": True},
        {"nearest_m": 3.0, "farthest_m": 3.0},
        {"hung": "mixed", "tilt_deg": 0.0},
    ],
)
def test_sessions_at_the_limits_are_made(changes: dict[str, Any]) -> None:
    session = board_session(1, BoardSettings.model_validate({**SMALL, **changes}))
    assert len(session.stands) == session.settings.placements
    assert len(session.given) == session.settings.cameras
    assert all(camera.T_lidar_camera is None for camera in session.given)


def test_a_board_is_held_and_carried() -> None:
    session, timing = _session(placements=3), Timing(held_s=2.0, carried_s=1.0)
    assert duration_s(session, timing) == 8.0
    there = [stand.T_lidar_board for stand in session.stands]
    for time_s, k in ((0.0, 0), (1.99, 0), (3.0, 1), (4.99, 1), (6.0, 2), (7.99, 2), (9.0, 2)):
        now = moment(session, timing, time_s)
        assert now.held and now.stand == k
        np.testing.assert_array_equal(now.T_lidar_board, there[k])
    halfway = moment(session, timing, 2.5)
    assert not halfway.held
    apart = [np.linalg.norm((inverse(T) @ halfway.T_lidar_board)[:3, 3]) for T in there[:2]]
    whole = np.linalg.norm((inverse(there[0]) @ there[1])[:3, 3])
    assert apart[0] == pytest.approx(apart[1], rel=0.01) and 0.4 * whole < apart[0] < whole


def test_a_log_is_the_same_again_and_read_by_others(tmp_path: Path) -> None:
    small = {"placements": 1, "cameras": 1, "columns": 360, "width_px": 320, "height_px": 240}
    timing = Timing(held_s=0.6, carried_s=0.3, turn_s=0.2, image_s=0.3)
    for name in ("a", "b"):
        write_log(_session(**small), tmp_path / name, timing, tmp_path / f"{name}.json")
    files = [(tmp_path / name / "sample_0.mcap").read_bytes() for name in ("a", "b")]
    assert files[0] == files[1]
    with AnyReader([tmp_path / "a"]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
        stamps = [stamp for _, stamp, _ in reader.messages()]
    assert counts == {"/lidar/points": 3, "/front/image_raw/compressed": 3, "/front/camera_info": 3}
    assert stamps == sorted(stamps)
    assert json.loads((tmp_path / "a.json").read_text())["cameras"][0]["name"] == "front"
