"""What speaks against a session before it is calibrated, said so that its user can mend it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.calibrate.boards import Stranger
from scanloom.stages.calibrate.rays import Bearings, board_pose, turn_and_shift
from scanloom.stages.calibrate.scene import Scene
from scanloom.stages.calibrate.start import Start
from scanloom.stages.geometry.se3 import F8

LEAST = 3
"""Two boards leave the third turn of a camera to the noise, and nothing to check it with."""
_SCALE_OFF = 0.03
_SCALE_SURE = 4.0
_OTHER_LENS = 0.4
"""Corners that scatter by less than this share under another camera's lens are that camera's."""
_LENS_PX = 0.08
"""Scatter from which a lens is doubted at all."""
_BLURRED = 5.0
_ALIKE_SHARE = 0.5


def check_count(scene: Scene, left_out: Mapping[tuple[str, str], str] | None = None) -> None:
    """Three placements at least, for each camera too.

    Raises
    ------
    InvalidInput : with the reasons why placements were left out.
    """
    if not scene.placements:
        raise InvalidInput(
            "no placement shows the board to the LiDAR and to a camera at once" + _because(left_out or {}),
            next_step="see that board.yaml is this board, and that clouds and images of a placement have the same name",
        )
    for camera in sorted(scene.models):
        n = len(scene.seen_by(camera))
        if n < LEAST:
            reasons = {where: why for where, why in (left_out or {}).items() if where[1] == camera}
            raise InvalidInput(
                f"{n} placement{'s' * (n != 1)} with the board in both cloud and image; three are the least: two leave a turn "
                "open and nothing to check the result with" + _because(reasons),
                where=f"camera {camera}",
                next_step="add placements, 8 to 15 in all, near and far, left and right, each tilted another way",
            )


def _because(left_out: Mapping[tuple[str, str], str]) -> str:
    if not left_out:
        return ""
    return "; left out: " + "; ".join(f"{name} ({why})" for (name, _), why in sorted(left_out.items()))


def blurred(scene: Scene, limit_px: float) -> dict[tuple[str, str], str]:
    """Images whose corners do not lie on a flat board, as far as their camera's usually do."""
    out = {}
    for camera in scene.cameras:
        sigma = {p.name: p.images[camera].sigma_px for p in scene.seen_by(camera)}
        usual = float(np.median(list(sigma.values()))) if sigma else 0.0
        for name, value in sigma.items():
            if value > max(limit_px, _BLURRED * usual):
                out[name, camera] = (
                    f"its corners scatter by {value:.1f} px about a flat board, {usual:.1f} px elsewhere: glare, motion or "
                    "another camera's image"
                )
    return out


def check_lenses(scene: Scene) -> None:
    """Whether the corners of one camera fit another's lens much better than their own.

    Raises
    ------
    InvalidInput : names both cameras.
    """
    corners = scene.board.corners_m()
    for camera in scene.cameras:
        images = [p.images[camera] for p in scene.seen_by(camera)]
        own = float(np.median([seen.sigma_px for seen in images])) if images else 0.0
        if own < _LENS_PX:
            continue
        for other in scene.cameras:
            if other == camera:
                continue
            fits = (board_pose(Bearings.of(scene.models[other], s.pixels), corners[s.index]) for s in images)
            scatter = [fit.rms_px for fit in fits if fit is not None]
            if len(scatter) == len(images) and np.median(scatter) < _OTHER_LENS * own:
                raise InvalidInput(
                    f"its corners scatter by {own:.2f} px under its own lens and by {np.median(scatter):.2f} px under that of "
                    f"camera {other}: images or camera files of the two are swapped",
                    where=f"camera {camera}",
                    next_step=f"exchange the images or the camera files of {camera} and {other}",
                )


def check_scale(scene: Scene) -> None:
    """Whether boards are as far apart in the images as in the clouds, which the size of the squares decides.

    Raises
    ------
    InvalidInput : with the size that would fit.
    """
    ratios = _ratios(scene)
    if len(ratios) < LEAST:
        return
    ratio = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
    if abs(ratio - 1.0) > max(_SCALE_OFF, _SCALE_SURE * spread / np.sqrt(len(ratios))):
        square = scene.board.square_m
        raise InvalidInput(
            f"by the images the boards stand {ratio:.3f} times as far apart as by the clouds: squares of {square / ratio:.4f} m "
            f"would fit, not {square:.4f} m",
            where="board.yaml",
            next_step="measure square_m over several squares, and see that the camera files are those of these images",
        )


def _ratios(scene: Scene) -> F8:
    """Distances between boards by image over those by cloud, for all pairs of placements of a camera."""
    found = []
    for camera in scene.cameras:
        seen = scene.seen_by(camera)
        by_image = np.array([p.images[camera].T_camera_board[:3, 3] for p in seen])
        by_cloud = np.array([p.cloud.T_lidar_board[:3, 3] for p in seen])
        for i in range(len(seen)):
            apart = np.linalg.norm(by_cloud[i + 1 :] - by_cloud[i], axis=1)
            far = apart > max(scene.board.board_m) / 2
            found.append(np.linalg.norm(by_image[i + 1 :] - by_image[i], axis=1)[far] / apart[far])
    return np.concatenate(found) if found else np.empty(0)


def check_start(first: Start) -> None:
    """Whether clouds and images show the same boards at all.

    Raises
    ------
    InvalidInput : fewer than half of a camera's placements agree on where it is.
    """
    for camera, names in first.agreeing.items():
        n = len(first.scene.seen_by(camera))
        if len(names) < max(LEAST, _ALIKE_SHARE * n):
            raise InvalidInput(
                f"only {len(names)} of {n} placements agree on where it is: clouds and images do not show the same boards",
                where=f"camera {camera}",
                next_step="see that clouds and images of a placement were taken together and are of this rig, and that the "
                "camera file is this camera's",
            )


def check_mounting(found: Mapping[str, F8], given: Mapping[str, F8]) -> None:
    """Whether cameras were found where others were said to be.

    Raises
    ------
    InvalidInput : names two cameras that stand in each other's place.
    """
    for camera in found:
        for other in found:
            if camera >= other or camera not in given or other not in given:
                continue
            straight = _apart(found[camera], given[camera]) + _apart(found[other], given[other])
            crossed = _apart(found[camera], given[other]) + _apart(found[other], given[camera])
            if crossed < 0.5 * straight:
                raise InvalidInput(
                    f"it was found where {other} was said to be, and {other} where it was: their images are swapped",
                    where=f"camera {camera}",
                    next_step=f"exchange the images of {camera} and {other}, or the poses in their camera files",
                )


def _apart(T: F8, other: F8) -> float:
    turn, shift = turn_and_shift(T, other)
    return turn + shift


def why_strange(stranger: Stranger) -> str:
    """What probably happened to a board that does not fit."""
    pair, error = stranger.pair, stranger.misfit
    turn, shift = np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:])
    away = pair.T_lidar_board[:3, 3] / np.linalg.norm(pair.T_lidar_board[:3, 3])
    along = float(pair.T_lidar_board[:3, :3].T[:, :] @ away @ error[3:])
    ratio = 1.0 + along / float(np.linalg.norm(pair.T_camera_board[:3, 3]))
    if abs(along) > 0.9 * shift and abs(ratio - 1.0) > 0.04 and turn < 5.0:
        return (
            f"by its image it stands {ratio:.2f} times as far as by its cloud: another board, with squares "
            f"{1 / ratio:.2f} times as large?"
        )
    return f"image and cloud are {100 * shift:.1f} cm and {turn:.1f} degrees apart: did the board move between them?"
