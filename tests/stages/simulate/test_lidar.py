"""The LiDAR moves while it turns: with the true motion the world stands still, without it does not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scanloom.schemas.scans import PointClass
from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import F8, transform
from scanloom.stages.simulate.meshes import Material
from scanloom.stages.simulate.sweeping import cast, scene_of
from scanloom.stages.simulate.town import Town, build_town
from tests.stages.simulate.conftest import SETTINGS, Recorded


@pytest.fixture(scope="module")
def town() -> Town:
    return build_town(SETTINGS.town_seed, SETTINGS.parking_seed)


def _in_world(recorded: Recorded, i: int, at_ns: NDArray[np.int64]) -> F8:
    T = interpolate_poses(recorded.truth.stamp_ns, recorded.truth.T_truth_lidar, at_ns)
    return np.einsum("nij,nj->ni", T[:, :3, :3], recorded.clouds[i].xyz) + T[:, :3, 3]


def _off_the_walls(recorded: Recorded, i: int, town: Town, *, moving: bool) -> F8:
    """Distance (n,) m of returns from houses to the surfaces of the town, near points only."""
    mesh = town.triangles()[0]
    cloud, label = recorded.clouds[i], recorded.labels[i]
    stamps = cloud.point_ns if moving else np.full(len(cloud.points), cloud.stamp_ns)
    points = _in_world(recorded, i, stamps)
    near = np.linalg.norm(cloud.xyz, axis=1) < 40
    rows = np.flatnonzero((label.class_ == PointClass.STATIC) & (label.instance > 0) & near)
    import open3d as o3d

    query = o3d.core.Tensor(points[rows].astype(np.float32))
    distance: F8 = scene_of(mesh).compute_distance(query).numpy().astype(float)
    return distance


def test_point_times_cover_the_sweep(recorded: Recorded) -> None:
    for cloud in recorded.clouds:
        time = cloud.points["time"]
        assert (np.diff(time) >= 0).all()
        assert time[0] < 0.01
        assert 0.09 < time[-1] < 0.1
    assert recorded.clouds[0].points["ring"].max() == SETTINGS.beams - 1


def test_true_motion_flattens_the_walls_to_the_range_noise(recorded: Recorded, town: Town) -> None:
    last = len(recorded.clouds) - 1
    speed = np.linalg.norm(np.diff(recorded.truth.T_truth_lidar[-11:, :3, 3], axis=0), axis=1).mean() * 100
    assert speed > 4
    straight = _off_the_walls(recorded, last, town, moving=True)
    smeared = _off_the_walls(recorded, last, town, moving=False)
    assert 0.006 < np.median(straight) < 0.02
    # Walls along the street hide the motion; those across it, and poles of windows, show it.
    assert np.percentile(straight, 90) < 0.05
    assert np.percentile(smeared, 90) > 3 * np.percentile(straight, 90)


def test_moving_cars_are_labelled_as_such(recorded: Recorded, town: Town) -> None:
    """Nothing that stands in the empty town is called moving: those points lie off its surfaces."""
    label = recorded.labels[-1]
    points = _in_world(recorded, -1, recorded.clouds[-1].point_ns)[label.class_ == PointClass.DYNAMIC]
    import open3d as o3d

    scene = scene_of(town.triangles()[0])
    distance = scene.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    assert np.median(distance) > 0.1


def test_another_day_parks_other_cars_and_moves_no_house(town: Town) -> None:
    other = build_town(SETTINGS.town_seed, SETTINGS.parking_seed + 1)
    same = [a.vertices.tobytes() == b.vertices.tobytes() for a, b in zip(town.parts, other.parts)]
    first = same.index(False)
    paints = {Material.PAINT_DARK, Material.PAINT_LIGHT, Material.METAL}
    for part in (*town.parts[first:], *other.parts[first:]):
        assert Material.RUBBER in set(part.material.tolist()) and paints & set(part.material.tolist())
    here, there = ([p.vertices.mean(axis=0) for p in t.parts[first:]] for t in (town, other))
    gone = cKDTree(np.array(there)).query(np.array(here))[0] > 2.0
    assert 0.2 < gone.mean() < 0.8


def test_bridge_is_above_the_street_it_crosses(town: Town) -> None:
    s = np.arange(0, town.path.length_m, 0.25)
    p = town.path.at(s)
    here = np.hypot(p[:, 0] - 44.0, p[:, 1] - 91.0) < 2.0
    assert np.ptp(p[here, 2]) > 5.0


def test_tunnel_closes_the_sky_over_its_whole_length(town: Town) -> None:
    s = np.arange(0, town.path.length_m, 1.0)
    p = town.path.at(s)
    up = np.column_stack((p + np.array([0, 0, 1.7]), np.tile([0.0, 0.0, 1.0], (len(p), 1)))).astype(
        np.float32
    )
    roof = cast(scene_of(town.triangles()[0]), up)["range"]
    covered = np.isfinite(roof) & (np.abs(p[:, 1]) < 4) & (p[:, 0] > 118)
    assert 60 < covered.sum() < 80


def test_transform_agrees_with_interpolation(recorded: Recorded) -> None:
    T = recorded.truth.T_truth_lidar[0]
    at = np.full(len(recorded.clouds[0].points), recorded.truth.stamp_ns[0])
    expected = transform(T, recorded.clouds[0].xyz)
    np.testing.assert_allclose(_in_world(recorded, 0, at), expected, atol=1e-9)
