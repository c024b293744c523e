"""One picture per placement and camera: the cloud on the image, and the board's face with the corners of both."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from scanloom.schemas.cameras import CameraModel
from scanloom.stages.calibrate.board import Board
from scanloom.stages.calibrate.rays import Bearings, on_board
from scanloom.stages.geometry.camera import project
from scanloom.stages.geometry.se3 import F8, inverse, transform

U1 = NDArray[np.uint8]
_WIDTH = 1100
_FACE = 560
_BY_IMAGE, _BY_CLOUD = (255, 60, 60), (60, 220, 255)


def picture(
    image: U1,
    points_m: F8,
    intensity: F8,
    T_lidar_camera: F8,
    model: CameraModel,
    board: Board,
    T_lidar_board: F8,
    pixels: F8,
    title: str,
) -> bytes:
    """A PNG: left the image (h, w) with points (n, 3) coloured by distance, right the board's face by reflectance.

    Corners by the image are red crosses, those by the cloud blue rings, in both halves.
    """
    left = _overlay(image, points_m, T_lidar_camera, model, board, T_lidar_board, pixels)
    right = _face(points_m, intensity, T_lidar_camera, model, board, T_lidar_board, pixels)
    height = max(left.height, right.height) + 22
    whole = Image.new("RGB", (left.width + right.width + 6, height), (20, 20, 24))
    whole.paste(left, (0, 22))
    whole.paste(right, (left.width + 6, 22))
    note = f"{title}   red: corners by the image   blue: by the cloud"
    ImageDraw.Draw(whole).text((6, 5), note, fill=(235, 235, 235))
    out = io.BytesIO()
    whole.save(out, "PNG", optimize=False)
    return out.getvalue()


def _overlay(
    image: U1, points: F8, T_lidar_camera: F8, model: CameraModel, board: Board, T_lidar_board: F8, pixels: F8
) -> Image.Image:
    scale = _WIDTH / model.width_px
    size = (_WIDTH, round(model.height_px * scale))
    drawn = Image.fromarray(image).convert("RGB").resize(size)
    canvas = np.array(drawn)
    there, seen = project(model, transform(inverse(T_lidar_camera), points))
    away = np.linalg.norm(points[seen], axis=1)
    _splat(canvas, there[seen] * scale, _rainbow(np.log(np.clip(away, 0.8, 30.0)), np.log(0.8), np.log(30.0)))
    drawn = Image.fromarray(canvas)
    by_cloud, _ = project(model, transform(inverse(T_lidar_camera) @ T_lidar_board, board.corners_m()))
    _mark(drawn, pixels * scale, by_cloud * scale, 4)
    return drawn


def _face(
    points: F8,
    intensity: F8,
    T_lidar_camera: F8,
    model: CameraModel,
    board: Board,
    T_lidar_board: F8,
    pixels: F8,
) -> Image.Image:
    x = transform(inverse(T_lidar_board), points)
    outline = board.outline_m()[:, :2]
    low, high = outline.min(axis=0) - 0.06, outline.max(axis=0) + 0.06
    scale = _FACE / float((high - low).max())
    near = (np.abs(x[:, 2]) < 0.1) & (x[:, :2] > low).all(axis=1) & (x[:, :2] < high).all(axis=1)
    size = np.round((high - low) * scale).astype(int)
    canvas = np.full((size[1], size[0], 3), 28, np.uint8)

    def place(xy: F8) -> F8:
        return np.column_stack(((xy[:, 0] - low[0]) * scale, (high[1] - xy[:, 1]) * scale))

    light = intensity[near]
    top = float(np.percentile(light, 90)) if light.size else 1.0
    shade = np.clip(light / max(top, 1e-9), 0.0, 1.0)
    tones = np.repeat((60 + 180 * shade)[:, None], 3, axis=1).astype(np.uint8)
    _splat(canvas, place(x[near, :2]), tones, 2)
    drawn = Image.fromarray(canvas)
    corners = place(outline)
    ImageDraw.Draw(drawn).polygon([tuple(p) for p in corners], outline=(90, 200, 90))
    met = on_board(inverse(T_lidar_board) @ T_lidar_camera, Bearings.of(model, pixels).directions)
    _mark(drawn, place(met), place(board.corners_m()[:, :2]), 5)
    return drawn


def _mark(drawn: Image.Image, by_image: F8, by_cloud: F8, r: int) -> None:
    pen = ImageDraw.Draw(drawn)
    for x, y in by_cloud[np.isfinite(by_cloud).all(axis=1)]:
        pen.ellipse((x - r, y - r, x + r, y + r), outline=_BY_CLOUD)
    for x, y in by_image[np.isfinite(by_image).all(axis=1)]:
        pen.line((x - r, y, x + r, y), fill=_BY_IMAGE)
        pen.line((x, y - r, x, y + r), fill=_BY_IMAGE)


def _splat(canvas: U1, at: F8, colours: U1, r: int = 1) -> None:
    """Small squares of colour (n, 3) at (n, 2)."""
    h, w = canvas.shape[:2]
    c = np.round(at).astype(np.int64)
    for dy in range(-r + 1, r):
        for dx in range(-r + 1, r):
            u, v = c[:, 0] + dx, c[:, 1] + dy
            inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
            canvas[v[inside], u[inside]] = colours[inside]


def _rainbow(values: F8, low: float, high: float) -> U1:
    """Red near, blue far."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    stops = np.array([(255, 40, 40), (255, 200, 0), (60, 230, 60), (0, 200, 255), (90, 60, 255)], float)
    at = t * (len(stops) - 1)
    i = np.minimum(at.astype(int), len(stops) - 2)
    mixed = stops[i] + (stops[i + 1] - stops[i]) * (at - i)[:, None]
    return np.asarray(mixed, np.uint8)
