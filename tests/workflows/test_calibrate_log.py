"""`calibrate` on logs: what it finds in one, and what it says of those in which nothing can be found."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from scanloom.schemas.errors import InvalidInput, UsageError
from scanloom.stages.calibrate.rays import turn_and_shift
from scanloom.stages.simulate.boards import BoardSession, BoardSettings, Timing, board_session, write_log
from scanloom.workflows.calibrate_rig import calibrate_rig, order_of, session_of

SMALL = BoardSettings(
    cameras=1, placements=3, columns=720, width_px=480, height_px=360, beams=32, farthest_m=2.5
)
TIMING = Timing(held_s=1.2, carried_s=0.3, turn_s=0.2, image_s=0.3)
WAITING = {"standstill": {"still_s": 0.8, "spacing_s": 0.3, "scans": 2}, "calibrate": {"halves": 0}}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, BoardSession]:
    session = board_session(3, SMALL)
    folder = tmp_path_factory.mktemp("log") / "boards"
    write_log(session, folder, TIMING)
    return folder, session


def test_a_log_is_calibrated(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    log, session = recorded
    outcome = calibrate_rig(order_of(log, tmp_path / "out", None, WAITING))
    calibration = outcome.calibration
    middles = [float(p.name[:-1]) for p in calibration.placements if p.used]
    np.testing.assert_allclose(middles, [0.6, 2.1, 3.6], atol=0.2)
    truth = np.array(session.cameras[0].T_lidar_camera)
    turn, shift = turn_and_shift(truth, np.array(calibration.cameras[0].T_lidar_camera))
    assert 1e-4 < np.degrees(turn) < 0.15 and 1e-5 < shift < 0.01
    assert (tmp_path / "out" / "calibration.json").is_file()
    assert len(list((tmp_path / "out" / "pictures").iterdir())) == 3


def test_scans_are_put_together(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    log, _ = recorded
    one, three = (
        session_of(order_of(log, tmp_path, None, {"standstill": {**WAITING["standstill"], "scans": n}}))
        for n in (1, 3)
    )
    for a, b in zip(one.placements, three.placements, strict=True):
        assert len(b.cloud().points_m) == pytest.approx(3 * len(a.cloud().points_m), rel=0.05)
        assert a.image("front") == b.image("front")
        assert a.where("front").endswith(f"camera front at {a.name}")


def refused(log: Path, out: Path, match: str, **settings: dict[str, object]) -> InvalidInput:
    with pytest.raises(InvalidInput, match=match) as raised:
        calibrate_rig(order_of(log, out, None, {**WAITING, **settings}))
    assert raised.value.where and raised.value.next_step
    assert not out.exists()
    return raised.value


def test_a_board_that_never_stands(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    longer = {**WAITING["standstill"], "still_s": 5.0}
    refused(recorded[0], tmp_path / "out", "never stands still for 5 s", standstill=longer)


def test_another_board_is_named(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(recorded[0], log)
    (log / "board.yaml").write_text("inner_corners: [6, 4]\nsquare_m: 0.095\nboard_m: [0.85, 0.61]\n")
    refused(log, tmp_path / "out", "they show one of 7 x 5")


def test_no_board_file(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    log = tmp_path / "log"
    shutil.copytree(recorded[0], log)
    (log / "board.yaml").unlink()
    refused(log, tmp_path / "out", "board cannot be read")


def test_clocks_that_do_not_agree(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    log, _ = recorded
    session = tmp_path / "session.yaml"
    session.write_text(yaml.safe_dump({"log": str(log), "cameras": {"front": {"clock_offset_s": 1000.0}}}))
    shutil.copy(log / "board.yaml", tmp_path)
    error = refused(session, tmp_path / "out", "No standstill has a scan")
    assert "clock_offset_s" in error.next_step


def test_a_log_without_cameras(tmp_path: Path) -> None:
    session = board_session(3, SMALL.model_copy(update={"placements": 1}))
    write_log(BoardSession(**{**vars(session), "given": ()}), tmp_path / "log", TIMING)
    refused(tmp_path / "log", tmp_path / "out", "no images")


def test_no_log_at_all(tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    error = refused(tmp_path / "nothing", tmp_path / "out", "no log")
    assert "clouds/" in error.next_step
    refused(tmp_path / "gone", tmp_path / "out", "no such file")


def test_settings_of_the_log(recorded: tuple[Path, BoardSession], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="lidar_topic"):
        session_of(order_of(recorded[0], tmp_path, None, {"ingest": {"lidar_topic": "/none/such"}}))
