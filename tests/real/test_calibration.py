"""14 real placements of a chessboard before one fisheye camera and one LiDAR of 16 beams."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.calibration import PUBLISHED_M, SPREAD_M
from benchmarks.calibration_crossing import alone
from scanloom.stages.calibrate.acceptance import together
from scanloom.stages.calibrate.calibration import calibrate
from scanloom.stages.calibrate.cloud import CloudSettings
from scanloom.stages.calibrate.cloud.evidence import SENSOR
from scanloom.stages.calibrate.settings import CalibrateSettings
from scanloom.workflows.calibrate_rig import look
from scanloom.workflows.calibration_folder import read_session

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def looked(shared_data):
    folder = shared_data / "lidar_camera_board"
    if not folder.is_dir():
        pytest.skip(f"real data is absent: {folder}")
    return look(read_session(folder, None), CloudSettings())


def test_all_placements_show_the_board(looked):
    assert len(looked.scene.placements) == 14 and not looked.unseen
    sigma = [p.images["camera"].sigma_px for p in looked.scene.placements]
    assert 0.05 < np.median(sigma) < 0.25


def test_left_out_placements_and_halves(looked):
    found = calibrate(looked.scene, CalibrateSettings())
    assert not found.left_out
    left_out = together(list(found.checks.left_out.values()))
    assert 0.3 < left_out.px < 1.7 and left_out.cm < 1.0
    spread = found.checks.spread["camera"]
    assert spread.halves == 10
    assert np.degrees(spread.rotation_max_rad) < 0.15 and spread.translation_max_m < 0.015
    crossing, sigma = found.estimate.sensor.known("crossing_m")
    assert 0.015 < crossing < 0.045 and sigma < 0.004


def test_believing_the_lidar_gives_the_published_place(looked):
    """Published solutions take the cloud as it is; so taken, ours lies within two of their standard deviations."""
    found = calibrate(looked.scene, CalibrateSettings(lidar="believed", halves=0))
    off = (found.estimate.T_lidar_camera["camera"][:3, 3] - PUBLISHED_M) / SPREAD_M
    assert (np.abs(off) < 2.0).all()


def test_clouds_alone_say_that_the_beams_cross_before_the_axis(looked):
    """No image takes part: board and print have known sizes."""
    mean, sigma = alone(looked.scene)
    crossing = SENSOR.index("crossing_m")
    assert 0.02 < mean[crossing] < 0.042
    assert mean[crossing] > 10 * sigma[crossing] > 0.0
