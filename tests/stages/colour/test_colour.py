"""Colour: what a camera saw gets its colour, what it did not see gets none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scanloom.schemas.objects import ObjectTracks
from scanloom.schemas.tiles import Tile
from scanloom.stages.geometry import ply
from scanloom.stages.geometry.se3 import pose
from scanloom.stages.geometry.srgb import LINEAR, srgb
from tests.stages.colour.scene import (
    BOX,
    BOX_HALF_M,
    BOX_X_M,
    CAMERA,
    LEFT,
    MODEL,
    RIGHT,
    START,
    WALL_X_M,
    image,
    painted,
    path,
    picture,
    tile,
)  # fmt: skip


def groups(made: Tile) -> dict[str, np.ndarray]:
    """Rows: the box, the wall left and right of it, and what it hides; clear of all edges by 0.5 m."""
    x, y, z = made.x_m, made.y_m - 25.0, made.z_m - 3.0
    wall = x > WALL_X_M - 0.5
    hidden = BOX_HALF_M * (WALL_X_M - START[0]) / (BOX_X_M - START[0])
    within = np.maximum(np.abs(y), np.abs(z))
    clear = wall & (np.abs(z) < 2.4) & (np.abs(y) < 5.4) & (within > hidden + 0.5) & (np.abs(y) > 0.4)
    return {
        "box": ~wall & (within < BOX_HALF_M - 0.3),
        "left": clear & (y > 0),
        "right": clear & (y < 0),
        "hidden": wall & (within < hidden - 0.1),
        "edge": wall & (within < hidden + 0.05),
    }


def test_points_get_the_colour_of_what_the_camera_saw() -> None:
    made = tile(painted([image(picture())], path(1)), grey=0.1)
    rows = groups(made)
    mean = {name: LINEAR[made.colour[rows[name]]].mean(axis=0) for name in ("box", "left", "right")}
    for name, light in (("box", BOX), ("left", LEFT), ("right", RIGHT)):
        assert (made.views[rows[name]] == 1).all(), name
        assert mean[name] / mean[name].max() == pytest.approx(light / light.max(), abs=0.02), name


def test_what_is_hidden_or_beside_an_edge_gets_no_colour() -> None:
    made = tile(painted([image(picture())], path(1)))
    rows = groups(made)
    assert rows["hidden"].sum() > 500
    for name in ("hidden", "edge"):
        assert not made.views[rows[name]].any(), name
        assert not made.colour[rows[name]].any(), name


def test_without_an_image_that_saw_it_nothing_has_a_colour() -> None:
    made = tile([])
    assert not made.views.any()
    assert not made.colour.any()
    assert painted([], path(1)) == []
    assert painted([image(picture(), camera="rear")], path(1)) == []
    assert (
        painted([image(picture())], path(1), camera=CAMERA.model_copy(update={"T_lidar_camera": None})) == []
    )
    assert painted([image(picture(), n=3)], path(2)) == [], "the path is not known at that time"


def test_images_are_brought_to_one_exposure() -> None:
    poses = path(2, step_m=0.5)
    even = tile(painted([image(picture()), image(picture(START + np.array((0.0, 0.5, 0.0))), 1)], poses))
    dark = tile(painted([image(picture()), image(picture(START + np.array((0.0, 0.5, 0.0)), 0.4), 1)], poses))
    twice = (even.views == 2) & (dark.views == 2)
    assert twice.sum() > 3000
    off = np.abs(even.colour[twice].astype(int) - dark.colour[twice])
    assert np.median(off) <= 1
    assert np.quantile(off, 0.95) <= 6


def test_what_one_image_alone_shows_has_to_be_seen_surely() -> None:
    """With these settings: by a cosine of 0.95 or more."""
    doubt = {"least_cosine": 0.095, "alone": 10.0, "tolerance_m": 1.0}
    one = tile(painted([image(picture())], path(1), **doubt))
    aside = np.hypot(one.y_m - 25.0, one.z_m - 3.0)
    wall = groups(one)["left"] | groups(one)["right"]
    flatly = aside > 1.05 * np.tan(np.arccos(0.95)) * (WALL_X_M - START[0])
    assert (wall & flatly).sum() > 300
    assert not one.views[wall & flatly].any()
    assert one.views[wall & (aside < 4.5)].all()
    beside = picture(START + np.array((0.0, 0.5, 0.0)))
    two = tile(painted([image(picture()), image(beside, 1)], path(2, step_m=0.5), **doubt))
    assert (two.views[wall & flatly] == 2).mean() > 0.9


def rolled(origin: np.ndarray, speed_m_s: float, readout_s: float, bands: int = 50) -> np.ndarray:
    """The picture of a camera that moves along y, its rows read one after another; `origin` is where it is in the middle."""
    rows = np.array_split(np.arange(MODEL.height_px), bands)
    middles = [readout_s * (band.mean() / (MODEL.height_px - 1) - 0.5) for band in rows]
    moved = (picture(origin + np.array((0.0, speed_m_s * t, 0.0))) for t in middles)
    return np.concatenate([one[band] for one, band in zip(moved, rows)])


def test_rows_of_a_rolling_shutter_are_thrown_from_where_they_were_taken() -> None:
    readout_s, poses = 0.08, path(3, step_m=2.0)
    speed_m_s = 2.0 / ((poses.stamp_ns[1] - poses.stamp_ns[0]) * 1e-9)
    shot = image(rolled(poses.T_world_lidar[1, :3, 3], speed_m_s, readout_s), 1)
    rolling = CAMERA.model_copy(update={"readout_s": readout_s})
    wrong = {}
    for name, camera in (("rolling", rolling), ("global", CAMERA)):
        made = tile(painted([shot], poses, camera=camera))
        y, z = made.y_m - 25.0, made.z_m - 3.0
        seam = (made.x_m > WALL_X_M - 0.5) & (np.abs(y) > 0.1) & (np.abs(y) < 0.7) & (np.abs(z) > 2.0)
        seam &= made.views > 0
        assert seam.sum() > 100
        reddish = made.colour[seam, 0] > made.colour[seam, 2]
        wrong[name] = np.mean(reddish != (y[seam] > 0))
    assert wrong["rolling"] < 0.01
    assert 0.08 < wrong["global"] < 0.5


def test_saturated_and_black_pixels_give_no_colour() -> None:
    bright, black = np.full((400, 640, 3), 251, np.uint8), np.full((400, 640, 3), 5, np.uint8)
    assert painted([image(bright)], path(1)) == []
    assert painted([image(black)], path(1)) == []
    assert len(painted([image(bright - 1)], path(1))) == 1
    assert len(painted([image(black + 1)], path(1))) == 1


def test_what_stands_behind_a_moving_thing_gets_no_colour() -> None:
    box = pose(np.eye(3), np.array([10.0, 3.0, -3.0]))[None]
    track = ObjectTracks(
        scan_index=np.zeros(1, np.int64), stamp_ns=path(1).stamp_ns, track=np.zeros(1, np.int32), T_odom_object=box,
        T_lidar_object=box, length_m=np.ones(1), width_m=np.full(1, 2.0), height_m=np.full(1, 6.0), speed_m_s=np.zeros(1),
        class_=np.ones(1, np.uint8), dynamic=np.ones(1, bool), score=np.ones(1),
    )  # fmt: skip
    made = tile(painted([image(picture())], path(1), track))
    y = made.y_m - 25.0
    wall = (made.x_m > 19.5) & (np.abs(made.z_m - 3.0) < 2.4)
    behind = wall & (y > 2.9) & (y < 5.5)
    assert behind.sum() > 500
    assert not made.views[behind].any()
    assert made.views[wall & (y < -2.9) & (y > -5.4)].all()
    parked = replace(track, dynamic=np.zeros(1, bool))
    assert tile(painted([image(picture())], path(1), parked)).views[behind & (y > 3.0) & (y < 5.3)].all()


def test_far_and_near_points_get_no_colour_from_an_image() -> None:
    wall_m = WALL_X_M - START[0]
    assert (
        not tile(painted([image(picture())], path(1), reach_m=wall_m - 0.5))
        .views[groups(tile([]))["left"]]
        .any()
    )
    assert (
        tile(painted([image(picture())], path(1), nearest_m=wall_m - 1)).views[groups(tile([]))["left"]].all()
    )
    assert (
        not tile(painted([image(picture())], path(1), nearest_m=wall_m - 1))
        .views[groups(tile([]))["box"]]
        .any()
    )


def test_values_of_srgb_come_back() -> None:
    assert np.array_equal(srgb(LINEAR), np.arange(256))


def test_a_tile_with_colour_has_it_in_its_ply() -> None:
    from scanloom.stages.tiling.tiles import tile_ply

    made = tile(painted([image(picture())], path(1)))
    head, _, body = tile_ply(made).partition(b"end_header\n")
    assert b"property uchar red" in head
    rows = np.frombuffer(body, ply.COLOURED)
    assert np.array_equal(np.column_stack([rows[c] for c in ("red", "green", "blue")]), made.colour)
    assert b"red" not in tile_ply(tile([])).partition(b"end_header\n")[0]


def test_a_camera_that_stands_still_adds_one_image() -> None:
    pictures = [image(picture(START + np.array((0.0, 0.3 * n, 0.0))), n) for n in range(4)]
    for apart_m, most in ((0.0, 4), (0.3 - 1e-6, 4), (0.31, 2), (10.0, 1)):
        assert tile(painted(pictures, path(4, step_m=0.3), apart_m=apart_m)).views.max() == most, apart_m


def test_a_view_that_disagrees_is_left_out() -> None:
    spoilt = picture(START + np.array((0.0, 0.3, 0.0)))
    spoilt[:, 400:] = (40, 200, 250)
    pictures = [image(picture(START + np.array((0.0, 0.3 * n, 0.0))), n) for n in (0, 2, 3)]
    pictures.insert(1, image(spoilt, 1))
    poses = path(4, step_m=0.3)
    good = tile(painted([pictures[0], *pictures[2:]], poses, apart_m=0.0))
    made = tile(painted(pictures, poses, apart_m=0.0))
    both = (good.views == 3) & (made.views > 0) & (made.x_m > 19.5)
    assert both.sum() > 3000 and (made.views[both] == 3).sum() > 1000
    off = np.abs(made.colour[both].astype(int) - good.colour[both]).max(axis=1)
    assert np.quantile(off, 0.95) <= 8
