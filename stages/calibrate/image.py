"""The board in an image: its corners to a fraction of a pixel, and how it stands before the camera by them alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board, Charuco
from scanloom.stages.calibrate.grid import pattern_in
from scanloom.stages.calibrate.rays import Bearings, board_pose
from scanloom.stages.geometry.se3 import F8

U1 = NDArray[np.uint8]

_SEARCH_PX = 1000
"""Longer side of the image in which the board is looked for; it is refined in the full one."""
_WINDOW = 0.3
"""Half the window of refinement, of the distance between corners: it holds one corner and much of its four squares."""
_WINDOW_PX = (2, 25)


@dataclass(frozen=True)
class ImageBoard:
    """Corners of one board in one image.

    `index` (n,) says which corner of `Board.corners_m` each of `pixels` (n, 2) is, in one of the orders that look the
    same: turning the board by 1/`turns` of a circle about its normal gives another that is as good.
    """

    index: NDArray[np.int64]
    pixels: F8
    turns: int
    sigma_px: float
    """Scatter of the corners about the best flat board: detection and lens model together."""
    T_camera_board: F8
    """The board by this image alone, in the order of `index`."""

    def turned(self, board: Board, turn: int) -> ImageBoard:
        """The same corners in another order: the board's frame turned by `turn` / `turns` of a circle about z."""
        T_turn = board_turn(turn, self.turns)
        index = turned_index(board, self.index, T_turn)
        return ImageBoard(index, self.pixels, self.turns, self.sigma_px, self.T_camera_board @ T_turn)


def board_turn(turn: int, turns: int) -> F8:
    """Pose (4, 4) of a board's frame that was turned about its normal."""
    quarter = (turn * 4 // turns) % 4
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    T = np.eye(4)
    T[:2, :2] = ((cosine, -sine), (sine, cosine))
    return T


def turned_index(board: Board, index: NDArray[np.int64], T_turn: F8) -> NDArray[np.int64]:
    """Numbers of the same corners of the board when its frame was turned by `T_turn`."""
    corners = board.corners_m()
    there = corners[index] @ T_turn[:3, :3]
    apart = np.linalg.norm(there[:, None, :] - corners[None, :, :], axis=2)
    return np.asarray(np.argmin(apart, axis=1), np.int64)


def find_corners(image: U1, board: Board, model: CameraModel, *, thorough: bool = True) -> ImageBoard | None:
    """Corners of the board in a grey image (h, w); None when it is not seen.

    A plain pattern by OpenCV's sector detector (Duda and Frese 2018) in a smaller image, else by its older one, then
    every corner at its saddle point in the full image; a pattern with markers by these. Not `thorough`: the first of them
    only, where many images show no board.
    """
    found = _marked(image, board, board.charuco) if board.charuco else _plain(image, board, thorough)
    if found is None:
        return None
    index, pixels = found
    bearings = Bearings.of(model, pixels)
    fit = board_pose(bearings, board.corners_m()[index])
    if fit is None:
        return None
    return ImageBoard(index, pixels, board.ambiguity, fit.rms_px, fit.T_camera_board)


def grey(data: bytes) -> U1 | None:
    """A grey image (h, w) from the bytes of a file; None when they are no image."""
    import cv2

    encoded = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE) if encoded.size else None
    return None if image is None else np.asarray(image, np.uint8)


def pattern_seen(image: U1) -> tuple[int, int] | None:
    """Inner corners of whatever chessboard the image shows, the longer side first; for the message when the expected one
    is not there."""
    small, _ = _reduced(image)
    for size in _PROBES:
        found = _sector(small, size)
        if found is not None:
            n, m = found.shape[:2]
            return max(m, n), min(m, n)
    return None


_PROBES = ((5, 4), (4, 4), (4, 3), (3, 3))


# --- plain patterns --------------------------------------------------------------------------------------------------


def _plain(image: U1, board: Board, thorough: bool) -> tuple[NDArray[np.int64], F8] | None:
    """Corners in an order that is right-handed with the board's normal towards the camera."""
    m, n = board.inner_corners
    small, scale = _reduced(image)
    corners = _detected(small, (m, n), thorough)
    if corners is None and scale < 1.0 and thorough:
        corners, scale = _detected(image, (m, n), thorough), 1.0
    if corners is None:
        return None
    rough = (corners + 0.5) / scale - 0.5
    pixels = _refined(image, rough.reshape(n, m, 2)).reshape(n, m, 2).transpose(1, 0, 2)
    if not _faces_camera(pixels):
        pixels = pixels[:, ::-1]
    return np.arange(m * n, dtype=np.int64), np.ascontiguousarray(pixels.reshape(-1, 2))


def _reduced(image: U1) -> tuple[U1, float]:
    import cv2

    scale = _SEARCH_PX / max(image.shape)
    if scale >= 1.0:
        return image, 1.0
    half = 0.5 ** np.ceil(-np.log2(scale))
    size = (round(image.shape[1] * half), round(image.shape[0] * half))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8), float(half)


def _detected(image: U1, size: tuple[int, int], thorough: bool) -> F8 | None:
    """Corners (m*n, 2), the first dimension running fastest; None where there is no board, or a larger one."""
    import cv2

    grid = _sector(image, size)
    if grid is not None:
        part = pattern_in(image, grid, *size[::-1])
        return None if part is None else part.reshape(-1, 2)
    if not thorough:
        return None
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    if not found or corners is None or corners.size != 2 * size[0] * size[1]:
        return None
    return np.asarray(corners, np.float64).reshape(-1, 2)


def _sector(image: U1, size: tuple[int, int]) -> F8 | None:
    """Corners (rows, columns, 2) of a pattern of at least this size: part of a larger one is not taken for it."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(image, size, flags)
    if not found or meta is None:
        return None
    return np.asarray(corners, np.float64).reshape(*meta.shape[:2], 2)


def _refined(image: U1, grid: F8) -> F8:
    """Saddle points (n, m, 2) near `grid`; a corner that runs away keeps its place."""
    import cv2

    gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    window = int(np.clip(_WINDOW * min(gaps), *_WINDOW_PX))
    start = grid.reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    fine = cv2.cornerSubPix(image, start.astype(np.float32), (window, window), (-1, -1), stop)
    fine = np.asarray(fine, np.float64).reshape(-1, 1, 2)
    strayed = np.linalg.norm(fine - start, axis=2) > window
    return np.asarray(np.where(strayed[..., None], start, fine).reshape(grid.shape))


def _faces_camera(pixels: F8) -> bool:
    """Whether turning from x to y on the board (m, n, 2) is counter-clockwise for the eye (v points down)."""
    x = pixels[-1].mean(axis=0) - pixels[0].mean(axis=0)
    y = pixels[:, -1].mean(axis=0) - pixels[:, 0].mean(axis=0)
    return bool(x[0] * y[1] - x[1] * y[0] < 0.0)


# --- patterns with markers -------------------------------------------------------------------------------------------


def _marked(image: U1, board: Board, charuco: Charuco) -> tuple[NDArray[np.int64], F8] | None:
    """Corners between the markers that are seen; at least six, and not in one line."""
    import cv2

    pattern = charuco_pattern(board, charuco)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(image)
    if ids is None or len(ids) < _LEAST_MARKED:
        return None
    m, n = board.inner_corners
    row, column = np.divmod(np.asarray(ids, np.int64).ravel(), m)
    if len(set(row)) < 2 or len(set(column)) < 2:
        return None
    return column * n + (n - 1 - row), np.asarray(corners, np.float64).reshape(-1, 2)


_LEAST_MARKED = 6


def charuco_pattern(board: Board, charuco: Charuco):  # type: ignore[no-untyped-def]  # cv2 has no types
    """OpenCV's model of the pattern: its x is ours, its y runs down where ours runs up."""
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, charuco.dictionary))
    count = (board.squares[0] * board.squares[1]) // 2
    ids = np.arange(charuco.first_id, charuco.first_id + count)
    pattern = cv2.aruco.CharucoBoard(board.squares, board.square_m, charuco.marker_m, dictionary, ids)
    pattern.setLegacyPattern(charuco.legacy)
    return pattern
