"""Cameras see the world that the LiDAR measures: where it is, in its colours; and change nothing else in the log."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from scanloom.schemas.cameras import Cameras
from scanloom.schemas.scans import PointClass, TruePoints
from scanloom.schemas.simulated import TrueColours
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import inverse, so3_log, transform
from scanloom.stages.simulate.cameras import told_mounts, true_mounts
from scanloom.stages.simulate.drive import Drive
from scanloom.stages.simulate.footage import Footage
from scanloom.stages.simulate.motion import build_motion
from scanloom.stages.simulate.paints import Paints
from scanloom.stages.simulate.rig import T_BASE
from scanloom.stages.simulate.settings import Settings
from scanloom.stages.simulate.stage import simulate
from scanloom.stages.simulate.town import Town

SETTINGS = Settings(
    size="small",
    duration_s=2.0,
    columns=256,
    start_m=20.0,
    standstill_s=0.0,
    cameras=3,
    camera_width_px=320,
    camera_height_px=200,
)
Message = tuple[str, bytes]


@dataclass(frozen=True)
class Filmed:
    log: Path
    truth: Path
    messages: list[tuple[str, str, bytes, Any]]
    """Topic, type, bytes as recorded, message."""

    def of(self, topic: str) -> list[Any]:
        return [message for name, _, _, message in self.messages if name == topic]


def _recorded(folder: Path, settings: Settings) -> Filmed:
    raw, truth = simulate(settings)
    raw.write(folder / "log")
    truth.write(folder / "truth")
    with AnyReader([folder / "log"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        messages = [
            (c.topic, c.msgtype, bytes(data), reader.deserialize(data, c.msgtype))
            for c, _, data in reader.messages()
        ]
    return Filmed(folder / "log", folder / "truth", messages)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    return _recorded(tmp_path_factory.mktemp("filmed"), SETTINGS)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Filmed:
    return _recorded(tmp_path_factory.mktemp("blind"), SETTINGS.model_copy(update={"cameras": 0}))


@cache
def _town() -> Town:
    return Drive(SETTINGS)._town()


def _footage(**changes: Any) -> Footage:
    s = SETTINGS.model_copy(update=changes)
    town = _town()
    motion = build_motion(s, town.path)
    return Footage(s, town, motion, Drive(s)._movers_of(town, motion), Paints(s.town_seed))


@pytest.fixture(scope="module")
def footage() -> Footage:
    return _footage()


def test_every_camera_has_images_and_its_lens_beside_them(filmed: Filmed) -> None:
    for name in ("cam_front", "cam_left", "cam_right"):
        images, infos = filmed.of(f"/{name}/image_raw/compressed"), filmed.of(f"/{name}/camera_info")
        assert len(images) == len(infos) == 4
        for image, info in zip(images, infos):
            assert image.header.stamp == info.header.stamp
            assert image.header.frame_id == info.header.frame_id == f"{name}_optical"
            pixels = cv2.imdecode(np.asarray(image.data), cv2.IMREAD_COLOR)
            assert pixels.shape == (info.height, info.width, 3) == (200, 320, 3)
            assert 40 < pixels.mean() < 190
            assert pixels.std() > 20


def test_cameras_change_nothing_else(filmed: Filmed, blind: Filmed) -> None:
    def others(log: Filmed) -> list[Message]:
        return [(t, data) for t, _, data, _ in log.messages if "cam_" not in t and t != "/tf_static"]

    assert others(filmed) == others(blind)
    assert not [t for t, *_ in blind.messages if "cam" in t]
    for name in ("points", "trajectory", "fixes", "objects", "tracks"):
        file = f"{name}.parquet"
        assert (filmed.truth / file).read_bytes() == (blind.truth / file).read_bytes(), file
    assert not (blind.truth / "colours.parquet").exists()
    assert not (blind.truth / "cameras.json").exists()


def test_settings_of_cameras_mean_nothing_without_cameras(blind: Filmed) -> None:
    changes = {
        "cameras": 0,
        "camera_turned_deg": 3.0,
        "readout_s": 0.05,
        "sun_share": 0.1,
        "lens": "equidistant",
    }
    raw, _ = simulate(SETTINGS.model_copy(update=changes))
    assert raw.read("sample_0.mcap") == (blind.log / "sample_0.mcap").read_bytes()


def test_same_seed_same_bytes(filmed: Filmed) -> None:
    raw, truth = simulate(SETTINGS)
    for product, folder in ((raw, filmed.log), (truth, filmed.truth)):
        for name in product.contents:
            again = hashlib.sha256(product.read(name)).digest()
            assert again == hashlib.sha256((folder / name).read_bytes()).digest(), name


def test_tf_is_the_calibration_and_truth_is_near_it(filmed: Filmed) -> None:
    (tf,) = filmed.of("/tf_static")
    frames = {t.child_frame_id: t.transform for t in tf.transforms}
    truth = Cameras.model_validate(json.loads((filmed.truth / "cameras.json").read_text()))
    for camera, told, true in zip(truth.cameras, told_mounts(SETTINGS), true_mounts(SETTINGS)):
        place = frames[f"{camera.name}_optical"].translation
        assert np.allclose((place.x, place.y, place.z), told[:3, 3], atol=1e-12)
        assert np.allclose(T_BASE["lidar"] @ np.array(camera.T_lidar_camera), true, atol=1e-12)
        off = inverse(told) @ true
        assert 1e-3 < np.degrees(np.linalg.norm(so3_log(off[:3, :3]))) < 0.15
        assert 1e-4 < np.linalg.norm(off[:3, 3]) < 0.015


def test_turned_cameras_are_turned_by_so_much() -> None:
    straight = SETTINGS.model_copy(update={"camera_error_deg": 0.0, "camera_error_m": 0.0})
    turned = straight.model_copy(update={"camera_turned_deg": 2.0})
    assert np.allclose(true_mounts(straight), told_mounts(straight), atol=1e-12)
    for before, after in zip(true_mounts(straight), true_mounts(turned)):
        off = inverse(before) @ after
        assert np.degrees(np.linalg.norm(so3_log(off[:3, :3]))) == pytest.approx(2.0, abs=1e-9)
        assert np.allclose(off[:3, 3], 0.0, atol=1e-12)


def _linear(srgb: np.ndarray) -> np.ndarray:
    level = srgb / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def _pairs(footage: Footage, filmed: Filmed, turned: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Albedo of ground points in the sun, and what the cameras see there, with the true poses or with cameras turned."""
    motion = build_motion(SETTINGS, _town().path)
    folder = filmed.truth
    cameras = Cameras.model_validate(json.loads((folder / "cameras.json").read_text()))
    labels = list(TruePoints.open(folder / "points.parquet"))
    colours = list(TrueColours.open(folder / "colours.parquet"))
    names, offsets = ["x", "y", "z", "time"], [0, 4, 8, 18]
    layout = np.dtype({"names": names, "formats": ["<f4"] * 4, "offsets": offsets, "itemsize": 22})
    clouds = [message.data.view(layout) for message in filmed.of("/lidar/points")]
    for index in (5, 15):
        points = clouds[index]
        t = index / SETTINGS.rate_hz
        world = motion.poses(t + points["time"].astype(float)) @ T_BASE["lidar"]
        xyz = np.column_stack([points[a] for a in "xyz"]).astype(float)
        at = np.einsum("nij,nj->ni", world[:, :3, :3], xyz) + world[:, :3, 3]
        use = (labels[index].class_ == PointClass.GROUND) & (colours[index].lit == 1)
        for k, camera in enumerate(cameras.cameras):
            radiance = footage.radiance(k, t)
            T = motion.poses(np.array([t]))[0] @ T_BASE["lidar"] @ np.array(camera.T_lidar_camera)
            if turned:
                T[:3, :3] = T[:3, :3] @ cv2.Rodrigues(np.array([0.0, 0.12, 0.0]))[0]
            pixels, seen = project(camera.model, transform(inverse(T), at))
            rows = np.flatnonzero(seen & use)
            u, v = np.rint(pixels[rows]).astype(int).T
            yield _linear(colours[index].albedo[rows].astype(float)), radiance[v, u]


def test_points_fall_on_their_own_colours(filmed: Filmed, footage: Footage) -> None:
    """Level ground in the sun sends its albedo; slopes, mirrors, haze and edges of patches are off a little."""
    off, off_turned = [], []
    for turned, into in ((False, off), (True, off_turned)):
        for albedo, radiance in _pairs(footage, filmed, turned):
            into.append(np.abs(radiance.mean(axis=1) / albedo.mean(axis=1) - 1))
    assert sum(map(len, off)) > 300
    close = float(np.mean(np.concatenate(off) < 0.15))
    assert 0.01 < np.median(np.concatenate(off)) < 0.1
    assert close > 0.65
    assert float(np.mean(np.concatenate(off_turned) < 0.15)) < close - 0.15


def test_truth_of_colours_is_complete(filmed: Filmed) -> None:
    labels = list(TruePoints.open(filmed.truth / "points.parquet"))
    colours = list(TrueColours.open(filmed.truth / "colours.parquet"))
    assert [len(c.albedo) for c in colours] == [len(p.class_) for p in labels]
    lit = np.concatenate([c.lit for c in colours])
    assert 0.15 < lit.mean() < 0.9
    albedo = np.concatenate([c.albedo for c in colours])
    assert albedo.min() > 10
    assert len(np.unique(albedo, axis=0)) > 500


def test_rolling_shutter_bends_what_passes(footage: Footage) -> None:
    moving, still = _footage(readout_s=0.06, traffic=False), _footage(traffic=False)
    t = 1.6
    assert np.abs(moving.radiance(1, t) - still.radiance(1, t)).mean() > 0.01
    resting: dict[str, Any] = {"standstill_s": 2.0, "traffic": False}
    a, b = _footage(readout_s=0.06, **resting), _footage(**resting)
    assert np.abs(a.radiance(1, 0.5) - b.radiance(1, 0.5)).mean() < 1e-3


def test_shadows_are_dark_and_the_sun_lights_as_much_as_asked_for(footage: Footage) -> None:
    """Level ground gets 1 in the sun and the sky's share of it in shadow; with an overcast sky 1 everywhere."""
    overcast = _footage(sun_share=0.0)
    for camera, shadow in ((0, (0.01, 0.2)), (2, (0.4, 0.8))):
        sunny, dull = footage.radiance(camera, 1.0)[110:, :, 1], overcast.radiance(camera, 1.0)[110:, :, 1]
        ratio = sunny / np.maximum(dull, 1e-6)
        assert shadow[0] < np.mean((ratio > 0.4) & (ratio < 0.7)) < shadow[1]
        assert np.mean((ratio > 0.85) & (ratio < 1.2)) > 0.1


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("cameras", 3, 4),
        ("cameras", 0, -1),
        ("camera_rate_hz", 0.1, 0.09),
        ("camera_width_px", 64, 63),
        ("camera_height_px", 48, 47),
        ("readout_s", 0.1, 0.11),
        ("camera_turned_deg", 30.0, 30.1),
        ("exposure_noise", 1.0, 1.1),
        ("jpeg_quality", 10, 9),
        ("sun_share", 0.95, 0.96),
        ("sun_elevation_deg", 5.0, 4.9),
        ("lens", "equidistant", "pinhole"),
    ],
)
def test_limits_of_settings(name: str, good: Any, bad: Any) -> None:
    assert getattr(Settings.model_validate({name: good}), name) == good
    with pytest.raises(ValidationError, match=name):
        Settings.model_validate({name: bad})
