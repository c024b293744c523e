"""A calibration session in memory: clouds, images on demand, corners without images, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import Camera, CameraModel
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, inverse, pose, se3_exp, so3_exp, transform
from scanloom.stages.simulate.boards.print import Print
from scanloom.stages.simulate.boards.rig import told_camera, true_cameras
from scanloom.stages.simulate.boards.room import Part, Scenery, board_parts, room
from scanloom.stages.simulate.boards.scan import Cloud, Scanner
from scanloom.stages.simulate.boards.settings import Bad, BoardSettings
from scanloom.stages.simulate.boards.shots import radiance_of, taken
from scanloom.stages.simulate.eye import F4, Eye
from scanloom.stages.simulate.sweeping import scene_of

_FACING = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a board that faces the LiDAR along its x: x of the board to the left, y down, z to the LiDAR."""
_TRIES = 300
_MOVED = (np.radians(4.0), 0.06)
"""By how much a board moves when it moves: rad and m, standard deviation of each axis."""
_SMEAR = 3.0
"""How much wider points become in the image of a board that moves."""
_SPREAD_DEG = 22.0
"""How far beside the middle of a camera's view the board is shown."""


@dataclass(frozen=True)
class Stand:
    """One place of the board, as it truly was."""

    name: str
    T_lidar_board: F8
    """When the cloud was taken."""
    T_lidar_seen: F8
    """When the images were taken."""
    board: Print
    bad: Bad | None


@dataclass(frozen=True)
class BoardSession:
    """A rig that was shown a board. `given` is what its user has, `cameras` and `stands` are the truth."""

    seed: int
    settings: BoardSettings
    board: Print
    cameras: tuple[Camera, ...]
    given: tuple[Camera, ...]
    stands: tuple[Stand, ...]
    scanner: Scanner
    _room: list[Part]
    _lamps: F8
    _eyes: dict[str, Eye] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the placements."""
        return tuple(stand.name for stand in self.stands)

    def cloud(self, k: int) -> Cloud:
        """What the LiDAR measured at placement `k`; the same every time."""
        stand = self.stands[k]
        return self.cloud_at(k, stand.T_lidar_board, np.random.default_rng((self.seed, 72, k)))

    def cloud_at(self, k: int, T_lidar_board: F8, rng: np.random.Generator) -> Cloud:
        """The same with the board of placement `k` somewhere else."""
        scene, scenery = self._scene(k, T_lidar_board)
        return self.scanner.scan(self.settings, scene, scenery, self.stands[k].board, T_lidar_board, rng)

    @cached_property
    def clouds(self) -> tuple[Cloud, ...]:
        """Clouds of all placements."""
        return tuple(self.cloud(k) for k in range(len(self.stands)))

    def image(self, camera: str, k: int) -> NDArray[np.uint8]:
        """Image (h, w, 3), red green blue, of a camera at placement `k`; a second or two each."""
        stand = self.stands[k]
        rng = np.random.default_rng((self.seed, 73, k, self._index(self._source(camera))))
        glare = self._glare(k, rng)
        blur = self.settings.blur_px * (_SMEAR if stand.bad == "moved" else 1.0)
        return taken(self.light(camera, k, stand.T_lidar_seen, glare), self._eye(camera), blur, rng)

    def light(self, camera: str, k: int, T_lidar_board: F8, glare: F8 | None = None) -> F4:
        """Light (h, w, 3) in a camera with the board of placement `k` anywhere."""
        scene, scenery = self._scene(k, T_lidar_board)
        T = np.array(self.cameras[self._index(self._source(camera))].T_lidar_camera)
        board = self.stands[k].board
        return radiance_of(self._eye(camera), T, scene, scenery, self._lamps, board, T_lidar_board, glare)

    def image_of(self, light: F4, camera: str, moving: bool, rng: np.random.Generator) -> NDArray[np.uint8]:
        """An image of `light`; one of a board that moves is smeared."""
        return taken(light, self._eye(camera), self.settings.blur_px * (_SMEAR if moving else 1.0), rng)

    def _eye(self, camera: str) -> Eye:
        source = self._source(camera)
        return self._eyes.setdefault(source, Eye(self.cameras[self._index(source)].model))

    def _glare(self, k: int, rng: np.random.Generator) -> F8 | None:
        """Where on the board a lamp is mirrored, and how large it is."""
        stand = self.stands[k]
        if stand.bad != "glare":
            return None
        spot = rng.uniform(-0.25, 0.25, 2) * np.asarray(stand.board.board_m)
        return np.append(spot, rng.uniform(0.08, 0.14))

    def true_corners(self, camera: str, k: int) -> tuple[F8, NDArray[np.bool_]]:
        """Pixels (n, 2) of the corners in an image and which of them it holds (n,), in the order of the board's corners;
        all false where the board is seen from behind or is not there."""
        stand = self.stands[k]
        lens = self.cameras[self._index(self._source(camera))]
        return corner_pixels(lens, stand.board, stand.T_lidar_seen, stand.bad != "no board")

    def corners(self, camera: str, k: int) -> F8 | None:
        """Noisy corners (n, 2) as a detector would find them in the image, without one; None where it finds none.

        A board that is partly out of the image, is mirrored over or is another one is not found.
        """
        stand = self.stands[k]
        pixels, there = self.true_corners(camera, k)
        if not there.all() or stand.bad in ("glare", "wrong board"):
            return None
        rng = np.random.default_rng((self.seed, 74, k, self._index(camera)))
        noise = self.settings.corner_noise_px * (3.0 if stand.bad == "moved" else 1.0)
        return pixels + noise * rng.standard_normal(pixels.shape)

    def truth(self) -> dict[str, Any]:
        """As JSON: cameras, boards, and what is wrong."""
        return {
            "seed": self.seed,
            "cameras": [camera.model_dump(mode="json") for camera in self.cameras],
            "range_offset_m": self.scanner.offset_m,
            "swapped": self.settings.swapped,
            "placements": [
                {
                    "name": stand.name,
                    "T_lidar_board": stand.T_lidar_board.tolist(),
                    "T_lidar_board_in_images": stand.T_lidar_seen.tolist(),
                    "bad": stand.bad,
                }
                for stand in self.stands
            ],
        }

    def _index(self, camera: str) -> int:
        return [c.name for c in self.cameras].index(camera)

    def _source(self, camera: str) -> str:
        """Whose image is in a camera's folder."""
        first_two = [c.name for c in self.cameras[:2]]
        if self.settings.swapped and camera in first_two:
            return first_two[1 - first_two.index(camera)]
        return camera

    def _scene(self, k: int, T_lidar_board: F8) -> tuple[Any, Scenery]:
        stand = self.stands[k]
        parts = list(self._room)
        if stand.bad != "no board":
            parts += board_parts(stand.board, T_lidar_board, np.random.default_rng((self.seed, 75, k)))
        scenery = Scenery.of(parts)
        return scene_of(scenery.mesh), scenery


def corner_pixels(
    camera: Camera, board: Print, T_lidar_board: F8, there: bool = True
) -> tuple[F8, NDArray[np.bool_]]:
    """Pixels (n, 2) of a board's corners and which of them are in the image (n,)."""
    T_camera_board = inverse(np.array(camera.T_lidar_camera)) @ T_lidar_board
    pixels, seen = project(camera.model, transform(T_camera_board, board.corners_m()))
    return pixels, seen & there & bool(inverse(T_camera_board)[2, 3] > 0)


def board_session(seed: int, settings: BoardSettings | None = None) -> BoardSession:
    """A session; the same seed and settings give the same one. Makes no cloud or image until asked for it."""
    s = settings or BoardSettings.model_validate({})
    rng = np.random.default_rng((seed, 70))
    board = Print(s.inner_corners, s.square_m, s.board_m, s.offset_m)
    cameras = true_cameras(s, rng)
    given = tuple(told_camera(camera, s, rng) for camera in cameras)
    scanner = Scanner.of(s, rng)
    parts, lamps = room(np.random.default_rng((seed, 71)))
    stands = _stands(s, board, cameras, rng)
    return BoardSession(seed, s, board, cameras, given, stands, scanner, parts, lamps)


def _stands(
    s: BoardSettings, board: Print, cameras: tuple[Camera, ...], rng: np.random.Generator
) -> tuple[Stand, ...]:
    """Cameras take turns in seeing the board; what goes wrong goes wrong at places drawn by chance."""
    chosen = rng.permutation(s.placements)[: len(s.bad)]
    bad: dict[int, Bad] = dict(zip(chosen.tolist(), s.bad))
    stands = []
    for k in range(s.placements):
        T = _shown(s, board, cameras[k % len(cameras)], rng)
        moved = se3_exp(np.repeat(_MOVED, 3) * rng.standard_normal(6))
        wrong = bad.get(k)
        seen = T @ moved if wrong == "moved" else T
        held = board.other() if wrong == "wrong board" else board
        stands.append(Stand(f"pose{k + 1}", T, seen, held, wrong))
    return tuple(stands)


def _shown(s: BoardSettings, board: Print, camera: Camera, rng: np.random.Generator) -> F8:
    """A place where the camera sees the whole board."""
    forward = np.array(camera.T_lidar_camera)[:3, 2]
    for _ in range(_TRIES):
        T = _held(s, float(np.arctan2(forward[1], forward[0])), rng)
        if _whole(camera.model, np.array(camera.T_lidar_camera), board, T):
            return T
    return T


def _held(s: BoardSettings, heading: float, rng: np.random.Generator) -> F8:
    heading = heading + np.radians(rng.uniform(-_SPREAD_DEG, _SPREAD_DEG))
    away = rng.uniform(s.nearest_m, s.farthest_m)
    turn = so3_exp((0.0, 0.0, heading))
    place = turn @ np.array([away, 0.0, away * rng.uniform(-0.15, 0.08)])
    tilt = np.radians(rng.uniform(-s.tilt_deg, s.tilt_deg, 2))
    diamond = s.hung == "diamond" or (s.hung == "mixed" and rng.random() < 0.5)
    middle = rng.choice([45.0, -45.0]) if diamond else rng.choice([0.0, 90.0])
    spin = np.radians(middle + rng.uniform(-12.0, 12.0))
    return pose(turn @ _FACING @ so3_exp((tilt[0], tilt[1], 0.0)) @ so3_exp((0.0, 0.0, spin)), place)


def _whole(model: CameraModel, T_lidar_camera: F8, board: Print, T_lidar_board: F8) -> bool:
    """Whether an image holds the whole plate, a little within its border, and the LiDAR and the camera see its print."""
    T_camera_board = inverse(T_lidar_camera) @ T_lidar_board
    pixels, seen = project(model, transform(T_camera_board, board.outline_m()))
    margin = 0.02 * model.width_px
    size = np.array([model.width_px, model.height_px])
    inside = (pixels > margin).all() and (pixels < size - margin).all()
    fronts = inverse(T_camera_board)[2, 3] > 0.3 and inverse(T_lidar_board)[2, 3] > 0.3
    return bool(seen.all() and inside and fronts)
