"""Rays and returns in the field of voxels, against sampling along the ray."""

from __future__ import annotations

import numpy as np
import pytest

from scanloom.schemas.scans import PointClass
from scanloom.stages.clean.field import (
    AFTER,
    BEFORE,
    BETWEEN,
    BLOCKED,
    FIRST_BRICKS,
    HITS,
    SATURATED,
    TRACKED,
    Field,
    brick_key,
    inner,
    row_of,
)
from scanloom.stages.clean.incidence import COLUMNS, LOWEST_RAD, ROW_RAD, ROWS, clear_ranges, fill, new_image
from scanloom.stages.clean.leading import CELL_RAD, WIDTH_SHARE, followed_since
from scanloom.stages.clean.tiles import brick_indices, bricks_by_tile
from scanloom.stages.clean.walking import NEAREST_M, counted, mark_hits, walk
from scanloom.stages.geometry.se3 import F8, pose, so3_exp
from scanloom.stages.geometry.voxels import pack

VOXEL_M, REACH_M = 0.2, 60.0
ORIGIN = pose(so3_exp([0.02, -0.03, 0.7]), [3.07, -5.11, 1.93])


def columns(points: F8) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(c) for c in points.astype(np.float32).T)


def marked(field: Field, points: F8, T: F8 = ORIGIN, *, moved: bool = False) -> None:
    n = len(points)
    classes = np.full(n, PointClass.STATIC, np.uint8)
    done = mark_hits(
        *columns(points), classes, np.full(n, moved), T, REACH_M, VOXEL_M, 0,
        field.keys, field.rows, field.order, field.count, field.now,
    )  # fmt: skip
    assert done == n


def walked(field: Field, points: F8, clear_m: np.ndarray, since_m: float = 0.0, start: int = 0) -> int:
    return walk(
        *columns(points), np.full(len(points), since_m, np.float32), clear_m.astype(np.float32), ORIGIN, REACH_M, VOXEL_M,
        start, field.keys, field.rows, field.order, field.count, field.now,
    )  # fmt: skip


def count(field: Field, layer: int, voxel: np.ndarray) -> int:
    i, j, k = (int(v) for v in voxel)
    row = row_of(field.keys, field.rows, brick_key(i, j, k))
    return int(field.counts[row, layer, inner(i, j, k)]) if row >= 0 else 0


def voxel_of(point: F8, T: F8 = ORIGIN) -> np.ndarray:
    return np.floor((T[:3, :3] @ point + T[:3, 3]) / VOXEL_M).astype(int)


@pytest.mark.parametrize("since_m", [0.0, 7.0])
@pytest.mark.parametrize(
    "direction", [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [3.0, -2.0, 0.5], [-1.0, 1.0, -1.0]]
)
def test_a_ray_passes_the_voxels_along_it_and_no_others(direction: list[float], since_m: float) -> None:
    way = np.array(direction) / np.linalg.norm(direction)
    point, field = 20.0 * way, Field()
    assert walked(field, point[None], np.array([15.0]), since_m) == 1
    field.settle()
    samples = np.arange(max(NEAREST_M, since_m) + 1e-4, 15.0, 0.003)
    sampled = {tuple(voxel_of(s * way)) for s in samples}
    assert all(count(field, BEFORE, np.array(v)) == 1 for v in sampled)
    total = int(field.counts[: len(field.bricks), BEFORE].sum())
    assert len(sampled) <= total <= 1.05 * len(sampled) + 2


def test_returns_block_their_surroundings_for_their_bin_only() -> None:
    field, wall = Field(), np.array([[10.0, 0.0, 0.0]])
    beyond, clear = np.array([[20.0, 0.0, 0.0]]), np.array([19.0])
    marked(field, wall)
    walked(field, beyond, clear)
    field.settle()
    at = voxel_of(wall[0])
    around = [at + np.array([a, b, c]) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]
    assert count(field, HITS, at) == 1
    assert not any(count(field, layer, v) for v in around for layer in (BEFORE, AFTER))
    walked(field, beyond, clear)
    field.settle()
    assert count(field, AFTER, at) == 1
    assert any(count(field, BEFORE, v) for v in around)
    marked(field, wall, moved=True)
    field.settle()
    assert (count(field, BETWEEN, at), count(field, AFTER, at), count(field, HITS, at)) == (1, 0, 2)
    assert count(field, TRACKED, at) == 1


def test_what_the_ground_returns_is_no_hit_but_blocks() -> None:
    field, point = Field(), np.array([[10.0, 0.0, 0.0]])
    ground = np.full(1, PointClass.GROUND, np.uint8)
    for _ in range(2):  # the second return in the same voxel finds it blocked already
        mark_hits(
            *columns(point), ground, np.ones(1, bool), ORIGIN, REACH_M, VOXEL_M, 0,
            field.keys, field.rows, field.order, field.count, field.now,
        )  # fmt: skip
    walked(field, 2.0 * point, np.array([19.0]))
    field.settle()
    at = voxel_of(point[0])
    assert not any(count(field, layer, at) for layer in (HITS, TRACKED, BEFORE, AFTER))
    marked(field, point)
    field.settle()
    assert count(field, HITS, at) == 1


def test_several_rays_and_returns_of_a_bin_count_once() -> None:
    field, beyond = Field(), np.array([[20.0, 0.0, 0.0]] * 5)
    marked(field, beyond)
    walked(field, beyond, np.full(5, 15.0))
    field.settle()
    assert count(field, BEFORE, voxel_of(np.array([10.0, 0, 0]))) == 1
    assert count(field, HITS, voxel_of(beyond[0])) == 1


def test_a_ray_that_is_nowhere_clear_says_nothing() -> None:
    field = Field()
    assert walked(field, np.array([[20.0, 0, 0], [5.0, 0, 0]]), np.array([NEAREST_M, np.nan])) == 2
    assert walked(field, np.array([[20.0, 0, 0]]), np.array([15.0]), 15.0) == 1
    assert len(field.bricks) == 0


def test_the_field_grows_when_it_is_full() -> None:
    field = Field()
    angle = np.linspace(-np.pi, np.pi, 3000, endpoint=False)
    points = 59.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.4 * np.sin(9 * angle)))
    clear, done = np.full(len(points), 58.0), 0
    while True:
        done = walked(field, points, clear, start=done)
        if done == len(points):
            break
        assert len(field.bricks) == len(field.order)
        field.grow()
    assert len(field.bricks) > FIRST_BRICKS
    roomy = Field()
    for _ in range(4):
        roomy.grow()
    assert walked(roomy, points, clear) == len(points)
    for each in (field, roomy):
        each.settle()
    a, b = np.argsort(field.bricks), np.argsort(roomy.bricks)
    assert (field.bricks[a] == roomy.bricks[b]).all()
    assert (field.counts[a, BEFORE] == roomy.counts[b, BEFORE]).all()


def test_counts_of_bins_stop_at_their_limit() -> None:
    field, beyond = Field(), np.array([[20.0, 0.0, 0.0]])
    for bins in range(SATURATED + 2):
        marked(field, beyond, moved=True)
        walked(field, beyond, np.array([15.0]))
        field.settle()
        assert count(field, BEFORE, voxel_of(np.array([10.0, 0, 0]))) == min(bins + 1, SATURATED)
    at = voxel_of(beyond[0])
    assert (count(field, HITS, at), count(field, TRACKED, at)) == (SATURATED, SATURATED)


def test_rays_that_lie_close_together_are_followed_where_they_part() -> None:
    """A fan as dense as a real one sees through the same voxels as with every ray followed from the start."""
    rng = np.random.default_rng(0)
    yaw, pitch = np.meshgrid(np.radians(np.arange(-20.0, 20.0, 0.18)), np.radians(np.arange(-8.0, 8.0, 0.4)))
    way = np.column_stack(
        [a.ravel() for a in (np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch))]
    )
    reach = np.where(rng.random(len(way)) < 0.2, rng.uniform(3.0, 12.0, len(way)), 40.0)
    points, image = reach[:, None] * way, new_image()
    since = followed_since(fill(*columns(points), image)[0], reach.astype(np.float32), VOXEL_M)
    assert (since == 0.0).sum() < 0.02 * len(way)
    assert since.max() == pytest.approx(WIDTH_SHARE * VOXEL_M / CELL_RAD)
    seen = []
    for start_m in (np.zeros_like(since), since):
        field = Field()
        walk(
            *columns(points), start_m, reach.astype(np.float32), ORIGIN, REACH_M, VOXEL_M, 0,
            field.keys, field.rows, field.order, field.count, field.now,
        )  # fmt: skip
        field.settle()
        seen.append({int(key): field.counts[row, BEFORE] for row, key in enumerate(field.bricks)})
    all_rays, leaders = seen
    assert set(leaders) <= set(all_rays)
    missed = sum(int(all_rays[k].sum()) - int(leaders[k].sum() if k in leaders else 0) for k in all_rays)
    assert 0 <= missed < 0.01 * sum(int(c.sum()) for c in all_rays.values())


def test_of_rays_in_a_cell_the_farthest_leads() -> None:
    cell, clear = np.array([5, 5, 5, -1, 9], np.int32), np.array([4.0, 9.0, 9.0, 30.0, 2.0], np.float32)
    since = followed_since(cell, clear, VOXEL_M)
    finest = WIDTH_SHARE * VOXEL_M / CELL_RAD
    assert since[[0, 2]] == pytest.approx(finest)
    assert since[[1, 3]].tolist() == [0.0, 0.0]
    assert since[4] == pytest.approx(
        finest / 2**4
    )  # columns 5 and 9 are in one cell where it is 16 columns wide


def test_grazing_rays_end_early_and_steep_ones_late() -> None:
    x = np.linspace(5.0, 40.0, 400)
    ground = np.column_stack((x, np.zeros_like(x), np.full_like(x, -1.8)))
    image = new_image()
    cell, _ = fill(*columns(ground), image)
    clear = clear_ranges(*columns(ground), cell, image, 0.3)
    r = np.linalg.norm(ground, axis=1)
    kept = np.array(sorted(set(image[image >= 0].tolist())))[2:-2]
    expected = 0.3 * r[kept] / 1.8  # clearance over the sine of the angle to level ground
    assert (np.abs((r - clear)[kept] - expected) < 0.25 * expected + 0.05).mean() > 0.95
    alone = np.array([[10.0, 0.0, 0.0]])
    assert clear_ranges(*columns(alone), fill(*columns(alone), image)[0], image, 0.3)[0] == pytest.approx(9.7)


def test_points_outside_the_image_say_nothing() -> None:
    up, image = np.array([[0.0, 0.0, 9.0], [np.nan, 0, 0], [0.0, 0, 0]]), new_image()
    cell, _ = fill(*columns(up), image)
    assert cell.tolist() == [-1, -1, -1]
    assert clear_ranges(*columns(up), cell, image, 0.3).tolist() == [0.0, 0.0, 0.0]


def test_every_brick_goes_to_the_tiles_it_reaches_into() -> None:
    rng = np.random.default_rng(0)
    bricks = np.array([pack(*(int(v) for v in ijk)) for ijk in rng.integers(-40, 40, (500, 3))], np.int64)
    bricks = np.unique(bricks)
    low = brick_indices(bricks) * 1.6
    found = dict(bricks_by_tile(bricks, 1.6, 20.0, 0.2))
    for n in range(len(bricks)):
        wanted = {
            f"{a}_{b}"
            for a in range(-5, 5)
            for b in range(-5, 5)
            if low[n, 0] < 20.0 * (a + 1) + 0.2 and low[n, 0] + 1.6 > 20.0 * a - 0.2
            and low[n, 1] < 20.0 * (b + 1) + 0.2 and low[n, 1] + 1.6 > 20.0 * b - 0.2
        }  # fmt: skip
        assert {name for name, rows in found.items() if n in rows} == wanted
    assert all((np.diff(bricks[rows]) > 0).all() for rows in found.values())


def test_cells_are_those_of_exact_angles_but_at_borders() -> None:
    rng = np.random.default_rng(9)
    way = rng.normal(size=(20000, 3))
    way[:3] = [[1.0, 0.0, 0.0], [-1.0, -1e-9, 0.0], [0.0, -1.0, 0.0]]
    points = (rng.uniform(0.5, 90.0, 20000) / np.linalg.norm(way, axis=1))[:, None] * way
    image = new_image()
    cell, away_m = fill(*columns(points), image)
    x, y, z = points.T
    row = np.floor((np.arcsin(z / np.linalg.norm(points, axis=1)) - LOWEST_RAD) / ROW_RAD).astype(int)
    column = np.floor(np.arctan2(y, x) % (2 * np.pi) * (COLUMNS / (2 * np.pi))).astype(int) % COLUMNS
    inside = (row >= 0) & (row < ROWS)
    same = np.where(inside, row * COLUMNS + column, -1) == cell
    assert 0.98 < same.mean() < 1.0
    seen = inside & (cell >= 0)
    aside = (cell % COLUMNS - column + COLUMNS // 2) % COLUMNS - COLUMNS // 2
    assert abs(cell // COLUMNS - row)[seen].max() <= 1
    assert abs(aside[seen]).max() <= 1
    assert away_m == pytest.approx(np.linalg.norm(points, axis=1), rel=1e-6)
    first = image[image >= 0]
    assert (np.diff(cell[first]) > 0).all()
    nearest = np.full(ROWS * COLUMNS, np.inf, np.float32)
    np.minimum.at(nearest, cell[cell >= 0], away_m[cell >= 0])
    assert np.array_equal(away_m[first], nearest[cell[first]])


def test_what_is_blocked_reaches_into_bricks_around() -> None:
    field = Field()
    at = np.array([[i, j, k] for i in (7, 8, 11) for j in (15, 20) for k in (-8, -1, 4)])
    points = ((at + 0.5) * VOXEL_M - ORIGIN[:3, 3]) @ ORIGIN[:3, :3]
    marked(field, points)
    blocked = set()
    for row, corner in enumerate(8 * brick_indices(field.bricks)):
        for q in np.flatnonzero(field.now[row] & BLOCKED):
            blocked.add(tuple(int(v) for v in np.add(corner, [q >> 6, (q >> 3) & 7, q & 7])))
    beside = np.array(list(np.ndindex(3, 3, 3))) - 1
    assert blocked == {tuple(int(v) for v in each + b) for each in at for b in beside}


def test_returns_that_count_come_with_whether_they_moved() -> None:
    rng = np.random.default_rng(1)
    points, classes = rng.normal(size=(500, 3)), rng.integers(0, 9, 500).astype(np.uint8)
    tracked, seen = rng.random(500) < 0.3, np.arange(9) % 2 == 1
    x, y, z, of, moved = counted(*columns(points), classes, tracked, seen)
    rows = classes % 2 == 1
    assert np.array_equal(np.column_stack((x, y, z)), points[rows].astype(np.float32))
    assert np.array_equal(of, classes[rows])
    assert np.array_equal(moved, (tracked | (classes == PointClass.DYNAMIC))[rows])
    assert 0 < moved.sum() < len(moved)


def test_leaders_are_found_at_either_end_of_the_image() -> None:
    last = ROWS * COLUMNS - 1
    for cell in ([0, 0], [last, last], [0, 0, last, last], [16 * COLUMNS - 1, 16 * COLUMNS - 1]):
        clear = np.arange(1.0, len(cell) + 1, dtype=np.float32)
        since = followed_since(np.array(cell, np.int32), clear, VOXEL_M)
        assert since[::2] == pytest.approx(WIDTH_SHARE * VOXEL_M / CELL_RAD)
        assert (since[1::2] == 0.0).all()
    assert (followed_since(np.full(3, -1, np.int32), np.ones(3, np.float32), VOXEL_M) == 0.0).all()


def test_a_ray_is_free_up_to_where_it_comes_close_to_what_its_neighbours_show() -> None:
    """Against the angles between rays and the lines to the next returns, one by one."""
    rng = np.random.default_rng(5)
    row, column = np.meshgrid(np.arange(100, 110), np.arange(300, 340), indexing="ij")
    kept = rng.random(row.size) < 0.8
    row, column = row.ravel()[kept], column.ravel()[kept]
    up, turn = LOWEST_RAD + (row + 0.5) * ROW_RAD, (column + 0.5) * 2 * np.pi / COLUMNS
    way = np.column_stack((np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)))
    points = rng.uniform(9.0, 11.0, len(way))[:, None] * way
    image = new_image()
    cell, _ = fill(*columns(points), image)
    assert np.array_equal(cell, row * COLUMNS + column)
    points, clear = (
        points.astype(np.float32).astype(float),
        clear_ranges(*columns(points), cell, image, 0.3),
    )

    def sine(n: int, steps: list[tuple[int, int]]) -> float | None:
        found = (image[row[n] + i, (column[n] + j) % COLUMNS] for i, j in steps)
        other = next((int(m) for m in found if m >= 0), None)
        if other is None:
            return None
        across = np.linalg.norm(np.cross(points[other] - points[n], points[n]))
        return float(across / np.linalg.norm(points[other] - points[n]) / np.linalg.norm(points[n]))

    for n in range(len(points)):
        beside = [sine(n, [(0, side), (0, 2 * side)]) for side in (-1, 1)]
        above = [sine(n, [(side * i, 0) for i in range(1, 6)]) for side in (-1, 1)]
        steeper = [max((s for s in pair if s is not None), default=1.0) for pair in (beside, above)]
        expected = np.linalg.norm(points[n]) - 0.3 / max(min(steeper), 0.02)
        assert clear[n] == pytest.approx(expected, abs=1e-3)
