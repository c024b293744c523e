"""Registration of a scan to a local map: robust Gauss-Newton on SE(3), point to plane or plane to plane.

Residuals, their derivatives and weights are in `residuals`, the steps in `descent`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scanloom.stages.geometry.descent import Sums, descend, linearise
from scanloom.stages.geometry.halves import in_halves
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.surfel_map import SurfelMap
from scanloom.stages.geometry.voxel_map import F4, I4, I8, STEPS, VoxelMap, fit_surface, nearest
from scanloom.stages.geometry.voxels import Float, Int, unpack

__all__ = ["Registration", "SurfelMap", "VoxelMap", "align", "normals_at"]

ROTATION_STEP_RAD = 5e-5
TRANSLATION_STEP_M = 1e-3
INNER_STEPS = 3
SETTLING = 8
SETTLED = 10.0
"""Partners may swap to and fro for ever: after this many searches, steps this many times larger count as none."""
MIN_MATCHES = 20
FEW, AFTER_FEW = 600, 20.0
"""So many points, at least, go first; what they leave to all points is small, and partners are then kept."""
NO_NORMALS, ALL_DIRECTIONS, NOTHING_KNOWN = np.zeros((0, 3)), np.eye(6), np.zeros((6, 6))
BOUND_SLACK, BOUND_SLACK_M2 = 1.0 + 1e-6, 1e-9


@dataclass(frozen=True)
class Registration:
    """Result of `align`.

    Attributes
    ----------
    T_target_source : (4, 4) pose of the source in the target.
    information : (6, 6) H = sum w J^T J at the solution, order (rotation, translation), right tangent, unscaled:
        the covariance of a well-conditioned result is sigma2 * inv(H).
    rmse_m : root mean square residual of the inliers, m; NaN without inliers.
    inlier_ratio : share of source points whose partner's surface is nearer than the scale of the robust kernel.
    converged : the last step was below the tolerance and there were enough partners.
    iterations : searches for partners that were made.
    gradient : (6,) b = sum w J^T e there; zero along all directions that were free.
    sigma2 : sum w e^2 / (sum w - 6), m2 (methods 1.7).
    points, normals : (k, 3) matched source points and their partners' normals, both in the source frame.
    residuals, weights : (k,) of these: distance along the normal, m, and robust weight times that of the shape.
    normal_variance : (k,) of the direction of these normals, from the fit of their surfaces, rad2.
    """

    T_target_source: F8
    information: F8
    rmse_m: float
    inlier_ratio: float
    converged: bool
    iterations: int
    sigma2: float
    gradient: F8
    points: F8
    normals: F8
    residuals: F8
    weights: F8
    normal_variance: F8


def align(
    target: VoxelMap | SurfelMap,
    source: ArrayLike,
    T_target_source: ArrayLike,
    *,
    max_distance_m: float,
    scale_m: float,
    max_iterations: int = 20,
    free: F8 | None = None,
    source_normals: F8 | None = None,
    held: F8 | None = None,
    few_first: int = 1,
) -> Registration:
    """Move `source` (n, 3), m, from the initial pose (4, 4) onto the surfaces of `target`.

    Parameters
    ----------
    max_distance_m : a point farther than this from every map point has no partner; at most one voxel is looked at.
    scale_m : residual at which the robust weight falls to a quarter.
    free : (6, k) directions of the tangent, as columns, in which the pose may move; all unless given.
    source_normals : (n, 3) unit normals of the surfaces the source points lie on, zero where there is none; with them
        residuals are plane to plane (see the module).
    held : (6, 6) information of the initial pose, rad-2, m-2, right tangent: how well it was known before. The result is
        then the most probable pose; `information` and `gradient` are those of the scan alone.
    few_first : every so many-th point alone is moved first, as far as it goes; all points then have little left to do.

    Few partners give `converged=False` and the best pose so far; nothing is raised.
    """
    points = np.ascontiguousarray(source, dtype=np.float64).reshape(-1, 3)
    T = np.array(T_target_source, dtype=np.float64)
    normals = NO_NORMALS if source_normals is None else np.ascontiguousarray(source_normals, dtype=np.float64)
    knowledge = _Knowledge.of(free, held, T)
    iterations = 0
    tolerance = 1.0
    if few_first > 1 and len(points) >= few_first * FEW:
        few = _Partners(np.ascontiguousarray(points[::few_first]), np.ascontiguousarray(normals[::few_first]))
        T, _, iterations = _settle(
            few, target, T, max_distance_m, scale_m, max_iterations - 1, knowledge, 1.0
        )
        tolerance = AFTER_FEW
    partner = _Partners(points, normals)
    T, converged, more = _settle(
        partner, target, T, max_distance_m, scale_m, max_iterations - iterations, knowledge, tolerance
    )
    H, b, residual = partner.linearise(T, scale_m)
    return _result(T, H, b, residual, partner, converged, iterations + more)


class _Knowledge(NamedTuple):
    """Directions (6, k) in which the pose may move, and what was known of it: information (6, 6), zero for nothing, and pose."""

    basis: F8
    information: F8
    T: F8

    @classmethod
    def of(cls, free: F8 | None, held: F8 | None, T: F8) -> _Knowledge:
        basis = ALL_DIRECTIONS if free is None else np.ascontiguousarray(free, dtype=np.float64)
        information = NOTHING_KNOWN if held is None else np.ascontiguousarray(held, dtype=np.float64)
        return cls(basis, information, T)


def _settle(
    partner: _Partners, target: VoxelMap | SurfelMap, T: F8, max_distance_m: float, scale_m: float, most: int,
    knowledge: _Knowledge, tolerance: float,
) -> tuple[F8, bool, int]:  # fmt: skip
    """Partners are searched, the pose moved, again and again until it stays: the pose, whether it stayed, searches."""
    converged, searches = False, 0
    while searches < most and not converged:
        searches += 1
        partner.search(target, T, max_distance_m)
        start = T
        T, matches = partner.descend(T, scale_m, knowledge)
        if searches > SETTLING:
            tolerance = SETTLED
        converged = matches >= MIN_MATCHES and _close(start, T, tolerance)
    return T, converged, searches


def normals_at(points: ArrayLike, surface_points: F8, voxel_size_m: float) -> F8:
    """Unit normals (n, 3) of the surfaces through `points` (n, 3), m, among `surface_points` (m, 3); zero without one."""
    around = VoxelMap(voxel_size_m)
    around.insert(surface_points)
    partner = _Partners(np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3), NO_NORMALS)
    partner.search(around, np.eye(4), voxel_size_m)
    normals: F8 = np.where(partner.shape[:, None] > 0, partner.normal, 0.0)
    return normals


class _Partners:
    """For each source point: mean and direction of its partner's surface in the target, and the weight of its shape."""

    def __init__(self, points: F8, normals: F8) -> None:
        n = len(points)
        self.points = points
        self.point_normal = normals
        self.voxel = np.full(n, -1, np.int64)
        self.place = np.zeros(n, np.int64)
        self.mean = np.zeros((n, 3))
        self.normal = np.zeros((n, 3))
        self.shape = np.zeros(n)
        self.normal_variance = np.zeros(n)
        self.error = np.zeros(n)
        self.weight = np.zeros(n)

    def search(self, target: VoxelMap | SurfelMap, T: F8, max_distance_m: float) -> None:
        points = self.points
        if isinstance(target, SurfelMap):
            target.partners(
                points, T, max_distance_m, self.mean, self.normal, self.shape, self.normal_variance
            )
            return
        size = target.voxel_size_m
        table = (target.keys, target.values, target.voxel_key, target.count, target.offset)
        limit2 = min(max_distance_m, size) ** 2
        radius2 = target.surface_radius_m**2

        def find(rows: slice) -> None:
            _find(points[rows], T, limit2, size, STEPS, *table, self.voxel[rows], self.place[rows])

        def fit(rows: slice) -> None:
            _fit(stale[rows], radius2, size, STEPS, *table, target.surface)

        in_halves(find, len(points))
        stale = _stale(self.voxel, self.place, target.inserts, target.refit_after, target.fitted)
        in_halves(fit, len(stale))
        _gather(
            self.voxel, self.place, size, target.voxel_key, target.surface, self.mean, self.normal, self.shape,
            self.normal_variance,
        )  # fmt: skip

    def descend(self, T: F8, scale_m: float, knowledge: _Knowledge) -> tuple[F8, int]:
        """The pose with the least residuals to these partners, and how many there are."""
        T_now, matches = descend(
            self.points, self.point_normal, T, scale_m**2, self.mean, self.normal, self.shape, self.error, self.weight,
            knowledge.basis, knowledge.information, knowledge.T, INNER_STEPS, MIN_MATCHES, ROTATION_STEP_RAD,
            TRANSLATION_STEP_M,
        )  # fmt: skip
        return T_now, int(matches)

    def linearise(self, T: F8, scale_m: float) -> tuple[F8, F8, Sums]:
        """H (6, 6), b (6,) and the sums of the residuals; their errors and weights are kept."""
        H, b = np.empty((6, 6)), np.empty(6)
        sums = linearise(
            self.points, self.point_normal, T, scale_m**2, self.mean, self.normal, self.shape, H, b, self.error,
            self.weight,
        )  # fmt: skip
        return H, b, Sums(*sums)


@kernel
def _moved(a: F8, b: F8) -> tuple[float, float]:
    """Turn, rad (for small ones), and way, m, between two poses."""
    turn2 = way2 = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        w = 0.0
        for m in range(3):
            w += 0.5 * (a[m, k] * b[m, j] - a[m, j] * b[m, k])
        turn2 += w * w
        way2 += (a[i, 3] - b[i, 3]) ** 2
    return np.sqrt(turn2), np.sqrt(way2)


def _close(a: F8, b: F8, tolerance: float) -> bool:
    turn, way = _moved(a, b)
    return bool(turn < tolerance * ROTATION_STEP_RAD and way < tolerance * TRANSLATION_STEP_M)


def _result(
    T: F8, H: F8, b: F8, residual: Sums, partner: _Partners, converged: bool, iterations: int
) -> Registration:
    rmse_m = float(np.sqrt(residual.inlier_square / residual.inliers)) if residual.inliers else float("nan")
    points, normals, residuals, weights, normal_variance = _matched(
        T,
        partner.points,
        partner.normal,
        partner.shape,
        partner.error,
        partner.weight,
        partner.normal_variance,
    )
    return Registration(
        T_target_source=T,
        information=H,
        rmse_m=rmse_m,
        inlier_ratio=residual.inliers / max(len(partner.points), 1),
        converged=converged,
        iterations=iterations,
        sigma2=residual.sigma2,
        gradient=b,
        points=points,
        normals=normals,
        residuals=residuals,
        weights=weights,
        normal_variance=normal_variance,
    )


@kernel
def _matched(
    T: F8, points: F8, normal: F8, shape: F8, error: F8, weight: F8, normal_variance: F8
) -> tuple[F8, F8, F8, F8, F8]:
    """Rows with a partner: points, normals in the frame of the source, residuals, weights, variances of the normals."""
    matches = 0
    for n in range(len(points)):
        matches += shape[n] > 0.0
    p, u, e, w, v = (
        np.empty((matches, 3)), np.empty((matches, 3)), np.empty(matches), np.empty(matches), np.empty(matches),
    )  # fmt: skip
    k = 0
    for n in range(len(points)):
        if not shape[n] > 0.0:
            continue
        for i in range(3):
            p[k, i] = points[n, i]
            u[k, i] = T[0, i] * normal[n, 0] + T[1, i] * normal[n, 1] + T[2, i] * normal[n, 2]
        e[k], w[k], v[k] = error[n], weight[n], normal_variance[n]
        k += 1
    return p, u, e, w, v


@kernel
def _find(
    points: F8, T: F8, limit2: Float, size: Float, steps: I8, keys: I8, values: I4, voxel_key: I8, count: I4,
    offset: F4, voxel: I8, place: I8,
) -> None:  # fmt: skip
    """Partner of every point: its `voxel` and `place` in it, or voxel -1. The partner of before bounds the search."""
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        bound2 = limit2
        v = voxel[n]
        if v >= 0:
            i, j, k = unpack(voxel_key[v])
            c = place[n]
            dx, dy = offset[v, c, 0] + i * size - x, offset[v, c, 1] + j * size - y
            dz = offset[v, c, 2] + k * size - z
            # A hair more, so that rounding lets the search find the same point again.
            bound2 = min(limit2, (dx * dx + dy * dy + dz * dz) * BOUND_SLACK + BOUND_SLACK_M2)
        voxel[n], place[n], _ = nearest(x, y, z, bound2, size, steps, keys, values, count, offset)


@kernel
def _stale(voxel: I8, place: I8, inserts: Int, refit_after: Int, fitted: I4) -> I8:
    """Partners (m, 2) whose surface has to be fitted, each once; they are marked as fitted."""
    out = np.empty((len(voxel), 2), np.int64)
    found = 0
    for n in range(len(voxel)):
        v, c = voxel[n], place[n]
        if v >= 0 and inserts - fitted[v, c] > refit_after:
            fitted[v, c] = inserts
            out[found, 0], out[found, 1] = v, c
            found += 1
    return out[:found]


@kernel
def _fit(
    stale: I8, radius2: Float, size: Float, steps: I8, keys: I8, values: I4, voxel_key: I8, count: I4, offset: F4,
    surface: F4,
) -> None:  # fmt: skip
    a, vectors = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(stale)):
        fit_surface(
            stale[n, 0], stale[n, 1], radius2, size, steps, keys, values, count, offset, voxel_key, surface, a,
            vectors,
        )  # fmt: skip


@kernel
def _gather(
    voxel: I8, place: I8, size: Float, voxel_key: I8, surface: F4, mean: F8, normal: F8, shape: F8,
    normal_variance: F8,
) -> None:  # fmt: skip
    for n in range(len(voxel)):
        v, c = voxel[n], place[n]
        if v < 0:
            shape[n] = 0.0
            continue
        i, j, k = unpack(voxel_key[v])
        mean[n, 0] = i * size + surface[v, c, 0]
        mean[n, 1] = j * size + surface[v, c, 1]
        mean[n, 2] = k * size + surface[v, c, 2]
        for r in range(3):
            normal[n, r] = surface[v, c, 3 + r]
        shape[n] = surface[v, c, 6]
        normal_variance[n] = surface[v, c, 7]
