"""Whole calibrations of simulated rigs, and what is refused or left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.board_scenes import World, glared, model, other_board, shifted, simulate
from benchmarks.calibration import _off
from scanloom.schemas.cameras import Camera
from scanloom.schemas.errors import InvalidInput
from scanloom.stages.calibrate.acceptance import together
from scanloom.stages.calibrate.calibration import calibrate
from scanloom.stages.calibrate.document import document, metrics
from scanloom.stages.calibrate.doubts import check_mounting
from scanloom.stages.calibrate.rays import Bearings, board_pose, turn_and_shift
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.stages.geometry.se3 import inverse, pose, se3_log

SETTINGS = CalibrateSettings(halves=3)


def cameras_of(scene):
    return {name: Camera(name=name, model=lens) for name, lens in scene.models.items()}


def test_three_cameras_agree_with_truth_and_know_how_well():
    errors, squares = [], []
    for seed in (11, 12, 13):
        scene, poses = simulate(World(), seed)
        found = calibrate(scene, CalibrateSettings(halves=0))
        for camera, T in found.estimate.T_lidar_camera.items():
            turn, shift = turn_and_shift(poses[camera], T)
            errors.append((np.degrees(turn), 1e3 * shift))
            xi = se3_log(inverse(poses[camera]) @ T)
            squares.append(xi @ np.linalg.solve(found.estimate.camera_covariance(camera), xi) / 6)
        assert not found.left_out
    deg, mm = np.array(errors).T
    assert 0.003 < np.sqrt((deg**2).mean()) < 0.05
    assert 0.1 < np.sqrt((mm**2).mean()) < 3.0
    assert 0.2 < np.mean(squares) < 2.0


def test_document_and_figures_of_one_camera():
    scene, _ = simulate(World(cameras=1, placements=7), 3)
    found = calibrate(scene, SETTINGS)
    calibration = document(found, cameras_of(scene), SETTINGS, {"pose99": "no board in the image"})
    assert calibration.verdict == "good", calibration.reason
    assert [p.name for p in calibration.placements if not p.used] == ["pose99"]
    assert calibration.certainty[0].weakest and "board" in calibration.certainty[0].advice
    again = type(calibration).model_validate(calibration.model_dump())
    assert again == calibration
    rows = {row["name"]: row["value"] for row in metrics(found, calibration)}
    left_out = together(list(found.checks.left_out.values()))
    assert rows["calibration.leave_one_out_px"] == left_out.px
    assert 0.1 < left_out.px < 3.0 and 0.02 < left_out.cm < 1.0
    residual = together(list(found.checks.residual.values()))
    assert residual.px < left_out.px


def test_start_20_degrees_and_half_a_metre_off_converges():
    for seed in (21, 22):
        scene, poses = simulate(World(), seed)
        rng = np.random.default_rng(seed)
        given = {name: T @ _off(rng, np.radians(20.0), 0.5) for name, T in poses.items()}
        far = calibrate(scene, CalibrateSettings(start="given", halves=0), given)
        near = calibrate(scene, CalibrateSettings(halves=0))
        for camera, T in near.estimate.T_lidar_camera.items():
            turn, shift = turn_and_shift(T, far.estimate.T_lidar_camera[camera])
            assert np.degrees(turn) < 0.02 and shift < 1e-3


def test_three_bad_placements_are_named_and_left_out():
    world = World()
    scene, poses = simulate(world, 31)
    rng = np.random.default_rng(31)
    p = list(scene.placements)
    p[1] = shifted(p[1], _off(rng, 0.0, 0.08))
    p[5] = glared(p[5], scene.models, world.board, rng)
    p[9] = other_board(p[9], scene.models, poses, world, rng)
    found = calibrate(Scene.of(scene.board, scene.models, tuple(p)), CalibrateSettings(halves=0))
    reasons = {name: why for (name, _), why in found.left_out.items()}
    assert set(reasons) == {p[1].name, p[5].name, p[9].name}
    assert (
        "move" in reasons[p[1].name]
        and "glare" in reasons[p[5].name]
        and "another board" in reasons[p[9].name]
    )


def test_a_lens_that_bends_otherwise_is_put_right():
    scene, poses = simulate(World(cameras=2, placements=12), 51)
    wrong = {name: _bent(lens) for name, lens in scene.models.items()}
    bent = Scene.of(scene.board, wrong, scene.placements)
    told = tuple(
        replace(p, images={c: refitted(bent, scene.board, c, seen) for c, seen in p.images.items()})
        for p in scene.placements
    )
    bent = replace(bent, placements=told)
    given = calibrate(bent, CalibrateSettings(halves=0, scatter_px=5.0)).estimate
    freed = calibrate(bent, CalibrateSettings(halves=0, scatter_px=5.0, lens_bend_px=8.0)).estimate
    before, after = (
        np.sqrt(np.mean([turn_and_shift(poses[c], T)[1] ** 2 for c, T in e.T_lidar_camera.items()]))
        for e in (given, freed)
    )
    assert 0.003 < before < 0.05 and 0.0003 < after < before / 2
    for camera, lens in scene.models.items():
        left = abs(freed.models[camera].distortion[0] - lens.distortion[0])
        assert 1e-6 < left < 0.4 * abs(wrong[camera].distortion[0] - lens.distortion[0])
        assert freed.models[camera].fx_px == pytest.approx(lens.fx_px, abs=1e-3)


def _bent(lens):
    return lens.model_copy(update={"distortion": (lens.distortion[0] + 0.01, *lens.distortion[1:])})


def test_a_free_focal_length_is_paid_for_in_certainty():
    scene, poses = simulate(World(cameras=1, placements=12), 53)
    kept, freed = (
        calibrate(scene, CalibrateSettings(halves=0, lens_share=share)).estimate for share in (0.0, 0.005)
    )
    sigma = [np.sqrt(np.diag(e.camera_covariance("cam0"))) for e in (kept, freed)]
    assert 2.0 < sigma[1][3:].max() / sigma[0][3:].max() < 20.0
    xi = se3_log(inverse(poses["cam0"]) @ freed.T_lidar_camera["cam0"])
    assert 0.1 < np.abs(xi / sigma[1]).max() < 3.0
    assert freed.models["cam0"].distortion == pytest.approx(scene.models["cam0"].distortion, abs=1e-6)


def test_of_two_boards_in_a_cloud_the_one_in_the_images_is_taken():
    scene, _ = simulate(World(cameras=2, placements=8), 32)
    elsewhere, _ = simulate(World(cameras=2, placements=8), 33)
    standing = elsewhere.placements[0].cloud
    doubled = tuple(
        replace(p, cloud=standing, others=(p.cloud,)) if k % 2 else replace(p, others=(standing,))
        for k, p in enumerate(scene.placements)
    )
    settings = CalibrateSettings(halves=0)
    alone = calibrate(scene, settings).estimate.T_lidar_camera
    both = calibrate(Scene.of(scene.board, scene.models, doubled), settings)
    assert not both.left_out
    for camera, T in both.estimate.T_lidar_camera.items():
        np.testing.assert_allclose(T, alone[camera], atol=1e-6)


@pytest.mark.parametrize(("placements", "fine"), [(2, False), (3, True)])
def test_three_placements_are_the_least(placements, fine):
    scene, poses = simulate(World(cameras=1, placements=placements), 41)
    if not fine:
        with pytest.raises(InvalidInput, match="three are the least"):
            calibrate(scene, SETTINGS)
        return
    found = calibrate(scene, SETTINGS)
    turn, shift = turn_and_shift(poses["cam0"], found.estimate.T_lidar_camera["cam0"])
    assert np.degrees(turn) < 0.3 and shift < 0.015
    calibration = document(found, cameras_of(scene), SETTINGS, {})
    assert calibration.verdict == "doubtful" and "3 placements" in calibration.reason


def test_squares_of_another_size_are_told_with_the_size():
    scene, _ = simulate(World(cameras=1, placements=8), 51)
    wrong = scene.board.model_copy(update={"square_m": 0.08})
    placements = tuple(
        replace(p, images={c: refitted(scene, wrong, c, seen) for c, seen in p.images.items()})
        for p in scene.placements
    )
    with pytest.raises(InvalidInput, match=r"squares of 0\.09[3-7]\d m would fit, not 0\.0800") as raised:
        calibrate(Scene.of(wrong, scene.models, placements), SETTINGS)
    assert raised.value.where == "board.yaml"


def refitted(scene, board, camera, seen):
    fit = board_pose(Bearings.of(scene.models[camera], seen.pixels), board.corners_m()[seen.index])
    return replace(seen, T_camera_board=fit.T_camera_board, sigma_px=fit.rms_px)


def test_swapped_lenses_are_named():
    scene, _ = simulate(World(cameras=2, placements=8), 61)
    models = {"cam0": scene.models["cam1"], "cam1": scene.models["cam0"]}
    crossed = Scene.of(scene.board, models, scene.placements)
    placements = tuple(
        replace(p, images={c: refitted(crossed, scene.board, c, seen) for c, seen in p.images.items()})
        for p in scene.placements
    )
    with pytest.raises(InvalidInput, match="swapped"):
        calibrate(Scene.of(scene.board, models, placements), CalibrateSettings(scatter_px=20.0))


def test_swapped_places_are_named():
    a, b = pose(np.eye(3), [0.2, 0.3, 0.0]), pose(np.eye(3), [0.2, -0.3, 0.0])
    check_mounting({"left": a, "right": b}, {"left": a, "right": b})
    with pytest.raises(InvalidInput, match="swapped"):
        check_mounting({"left": b, "right": a}, {"left": a, "right": b})
    check_mounting({"left": b, "right": a}, {"left": a})


def test_clouds_and_images_of_different_placements_are_refused():
    scene, _ = simulate(World(cameras=1, placements=8), 71)
    clouds = [p.cloud for p in scene.placements]
    mixed = tuple(replace(p, cloud=clouds[(i + 3) % 8]) for i, p in enumerate(scene.placements))
    with pytest.raises(InvalidInput):
        calibrate(Scene.of(scene.board, scene.models, mixed), SETTINGS)


def test_published_method_stays_where_epnp_put_it():
    scene, poses = simulate(World(cameras=1, placements=8), 81)
    paper = calibrate(scene, CalibrateSettings(method="paper", halves=2))
    ours = calibrate(scene, CalibrateSettings(halves=2))
    far = [turn_and_shift(poses["cam0"], f.estimate.T_lidar_camera["cam0"])[1] for f in (paper, ours)]
    assert far[1] < far[0] < 0.1
    assert model(0).lens == "radial-tangential"
