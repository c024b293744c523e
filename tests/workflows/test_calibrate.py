"""`calibrate` on folders: what it writes, and what it says of sessions that cannot be calibrated."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from benchmarks.board_scenes import World, simulate
from scanloom.schemas.calibration import Calibration
from scanloom.schemas.errors import EXIT_INVALID_INPUT, InvalidInput, UsageError
from scanloom.schemas.metrics import kind_of
from scanloom.stages.logs.camera_files import read_camera_file
from scanloom.workflows import calibrate_rig as rig
from scanloom.workflows.calibrate_rig import Looked, Order, calibrate_rig, order_of, text_of
from scanloom.workflows.calibration_folder import PointCloud, read_session
from scanloom.workflows.cli import app

BOARD = {"inner_corners": [7, 5], "square_m": 0.095, "board_m": [0.85, 0.61]}


def camera_file(path: Path, lens) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    name = {"equidistant": "fisheye"}.get(lens.lens, "plumb_bob")
    content = {
        "distortion_model": name,
        "width": lens.width_px,
        "height": lens.height_px,
        "D": list(lens.distortion) or [0.0] * 4,
        "K": [lens.fx_px, 0.0, lens.cx_px, 0.0, lens.fy_px, lens.cy_px, 0.0, 0.0, 1.0],
    }
    path.write_text(yaml.safe_dump(content))


def pcd(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"VERSION 0.7\nFIELDS x y z intensity ring\nSIZE 4 4 4 4 2\nTYPE F F F F U\nCOUNT 1 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA ascii\n"
    path.write_text(
        head + "".join(f"{x:.4f} {y:.4f} {z:.4f} 5 {i % 4}\n" for i, (x, y, z) in enumerate(points))
    )


@pytest.fixture
def session(tmp_path):
    """Three cameras, three placements: walls and blank images."""
    scene, _ = simulate(World(placements=12), 5)
    for name, lens in scene.models.items():
        camera_file(tmp_path / "camera_info" / f"{name}.yaml", lens)
        for k in range(3):
            path = tmp_path / "images" / name / f"pose{k}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full((lens.height_px, lens.width_px), 90, np.uint8))
    rng = np.random.default_rng(0)
    for k in range(3):
        wall = np.column_stack((np.full(400, 5.0), rng.uniform(-3, 3, 400), rng.uniform(-1, 1, 400)))
        pcd(tmp_path / "clouds" / f"pose{k}.pcd", wall)
    (tmp_path / "board.yaml").write_text(yaml.safe_dump(BOARD))
    return SimpleNamespace(folder=tmp_path, scene=scene)


def seen_as(monkeypatch, scene):
    """What the files show is the simulated scene."""
    cloud = PointCloud(np.random.default_rng(1).uniform(1, 4, (200, 3)), np.ones(200), None)
    placements = scene.placements
    looked = Looked(scene, {p.name: cloud for p in placements}, {"pose99": "no board in the cloud"})
    monkeypatch.setattr(rig, "look", lambda session, settings: looked)


def test_everything_is_written(session, monkeypatch, tmp_path):
    seen_as(monkeypatch, session.scene)
    out = tmp_path / "out"
    outcome = calibrate_rig(order_of(session.folder, out, None, {"calibrate": {"halves": 2}}))
    calibration = Calibration.open(out / "calibration.json")
    assert calibration == outcome.calibration
    assert [c.name for c in calibration.cameras] == ["cam0", "cam1", "cam2"]
    entries = read_camera_file(out / "calibration.json")
    assert [e.camera for e in entries] == list(calibration.cameras)
    rows = json.loads((out / "metrics.json").read_text())
    names = [row["name"] for row in rows]
    assert "calibration.leave_one_out_px" in names and "calibration.leave_one_out_cm" in names
    assert all(kind_of(name) is not None for name in names)
    assert (out / "exports" / "rig.urdf").is_file()
    text = text_of(outcome)
    assert "pose99" in text and "written" in text
    assert json.dumps(outcome.as_json())


def test_nothing_is_written_when_it_is_refused(session, monkeypatch, tmp_path):
    scene = session.scene.only(session.scene.names[:2])
    seen_as(monkeypatch, scene)
    with pytest.raises(InvalidInput, match="three are the least") as raised:
        calibrate_rig(Order(session.folder, tmp_path / "out"))
    assert "pose99" in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_blank_images(session, tmp_path):
    with pytest.raises(InvalidInput, match="No image shows a board of 7 x 5"):
        calibrate_rig(Order(session.folder, tmp_path / "out"))


def test_an_image_of_another_size_is_named(session, tmp_path):
    path = session.folder / "images" / "cam1" / "pose2.png"
    cv2.imwrite(str(path), np.full((480, 640), 90, np.uint8))
    with pytest.raises(InvalidInput, match="640 x 480") as raised:
        calibrate_rig(Order(session.folder, tmp_path / "out"))
    assert raised.value.where == str(path)


def test_no_image_at_all(session, tmp_path):
    (session.folder / "images" / "cam1" / "pose2.png").write_bytes(b"nothing")
    with pytest.raises(InvalidInput, match="no image"):
        calibrate_rig(Order(session.folder, tmp_path / "out"))


def test_no_board_in_any_cloud(session, monkeypatch, tmp_path):
    monkeypatch.setattr(rig, "_corners", lambda s, p, c: session.scene.placements[0].images.get(c))
    with pytest.raises(InvalidInput, match=r"No cloud shows a board of 0\.85 x 0\.61 m"):
        calibrate_rig(Order(session.folder, tmp_path / "out"))


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / "camera_info" / "cam1.yaml").unlink(), "cam1 has images and no camera file"),
        (lambda f: [p.unlink() for p in (f / "camera_info").iterdir()], "No camera file"),
        (lambda f: (f / "board.yaml").unlink(), "board cannot be read"),
        (lambda f: [p.rename(p.with_stem("x" + p.stem)) for p in (f / "clouds").iterdir()], "No image has the name"),
        (lambda f: (f / "clouds").rename(f / "scans"), "no calibration session"),
        (lambda f: (f / "camera_info" / "cam1.yaml").write_text("width: 5\n"), "camera"),
        (lambda f: camera_file(f / "camera_info" / "cam9.yaml", simulate(World(cameras=1, placements=1), 0)[0].models["cam0"]), "cam9 has a camera file and no images"),
    ],
)  # fmt: skip
def test_folders_that_lack_something(session, break_it, message):
    break_it(session.folder)
    with pytest.raises(InvalidInput, match=message) as raised:
        read_session(session.folder, None)
    assert raised.value.where and raised.value.next_step


def test_settings():
    given = {"calibrate": {"method": "paper"}, "cloud": {"max_range_m": 9.0}, "standstill": {"scans": 3}}
    order = order_of(Path("a"), Path("b"), None, given)
    assert order.calibrate.method == "paper" and order.cloud.max_range_m == 9.0
    assert order.log.standstill.scans == 3
    with pytest.raises(UsageError, match="odometry"):
        order_of(Path("a"), Path("b"), None, {"odometry": {}})
    with pytest.raises(UsageError, match=r"calibrate\.halfs"):
        order_of(Path("a"), Path("b"), None, {"calibrate": {"halfs": 2}})


def test_command_line_fails_as_for_bad_input(session, tmp_path):
    result = CliRunner().invoke(app, ["calibrate", str(session.folder), "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, InvalidInput)
    assert result.exception.exit_code == EXIT_INVALID_INPUT
    assert not (tmp_path / "out").exists()
