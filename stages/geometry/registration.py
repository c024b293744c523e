"""Registration of a scan to a local map: robust Gauss-Newton on SE(3), point to plane or plane to plane.

Residuals, their derivatives and weights are in `residuals`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scanloom.stages.geometry.halves import in_halves
from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.residuals import linearise_planes, linearise_points
from scanloom.stages.geometry.se3 import F8, inverse, se3_exp, se3_log
from scanloom.stages.geometry.voxel_map import F4, I4, I8, STEPS, VoxelMap, fit_surface, nearest
from scanloom.stages.geometry.voxels import Float, Int, unpack

__all__ = ["Registration", "VoxelMap", "align", "normals_at"]

ROTATION_STEP_RAD = 5e-5
TRANSLATION_STEP_M = 1e-3
INNER_STEPS = 3
SETTLING = 8
SETTLED = 10.0
"""Partners may swap to and fro for ever: after this many searches, steps this many times larger count as none."""
MIN_MATCHES = 20
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
    target: VoxelMap,
    source: ArrayLike,
    T_target_source: ArrayLike,
    *,
    max_distance_m: float,
    scale_m: float,
    max_iterations: int = 20,
    free: F8 | None = None,
    source_normals: F8 | None = None,
    held: F8 | None = None,
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

    Few partners give `converged=False` and the best pose so far; nothing is raised.
    """
    points = np.ascontiguousarray(source, dtype=np.float64).reshape(-1, 3)
    T = np.array(T_target_source, dtype=np.float64)
    partner = _Partners(points, source_normals)
    expected, known = T, None if held is None else np.asarray(held, float)
    basis = np.eye(6) if free is None else np.asarray(free, float)
    converged, iterations = False, 0
    H, b, residual = np.zeros((6, 6)), np.zeros(6), _Residuals()
    while iterations < max_iterations and not converged:
        iterations += 1
        partner.search(target, T, max_distance_m)
        start = T
        for _ in range(INNER_STEPS):
            H, b, residual = partner.linearise(T, scale_m)
            if residual.matches < MIN_MATCHES:
                break
            if known is not None:
                H, b = _with_knowledge(H, b, residual.sigma2, known, expected, T)
            step = _step(H, b, basis)
            T = T @ se3_exp(step)
            if _small(step):
                break
        tolerance = 1.0 if iterations <= SETTLING else SETTLED
        converged = residual.matches >= MIN_MATCHES and _close(start, T, tolerance)
    H, b, residual = partner.linearise(T, scale_m)
    return _result(T, H, b, residual, partner, converged, iterations)


def normals_at(points: ArrayLike, surface_points: F8, voxel_size_m: float) -> F8:
    """Unit normals (n, 3) of the surfaces through `points` (n, 3), m, among `surface_points` (m, 3); zero without one."""
    around = VoxelMap(voxel_size_m)
    around.insert(surface_points)
    partner = _Partners(np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3))
    partner.search(around, np.eye(4), voxel_size_m)
    normals: F8 = np.where(partner.shape[:, None] > 0, partner.normal, 0.0)
    return normals


@dataclass(frozen=True)
class _Residuals:
    matches: int = 0
    weight: float = 0.0
    weighted_square: float = 0.0
    inliers: int = 0
    inlier_square: float = 0.0

    @property
    def sigma2(self) -> float:
        freedom = self.weight - 6
        return self.weighted_square / freedom if freedom > 0 else float("inf")


class _Partners:
    """For each source point: mean and direction of its partner's surface in the target, and the weight of its shape."""

    def __init__(self, points: F8, normals: F8 | None = None) -> None:
        n = len(points)
        self.points = points
        self.point_normal = None if normals is None else np.ascontiguousarray(normals, dtype=np.float64)
        self.voxel = np.full(n, -1, np.int64)
        self.place = np.zeros(n, np.int64)
        self.mean = np.zeros((n, 3))
        self.normal = np.zeros((n, 3))
        self.shape = np.zeros(n)
        self.normal_variance = np.zeros(n)
        self.error = np.zeros(n)
        self.weight = np.zeros(n)

    def search(self, target: VoxelMap, T: F8, max_distance_m: float) -> None:
        points = self.points
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

    def linearise(self, T: F8, scale_m: float) -> tuple[F8, F8, _Residuals]:
        """H (6, 6), b (6,) and the sums of the residuals; their errors and weights are kept."""
        H, b = np.zeros((6, 6)), np.zeros(6)
        surfaces, results = (self.mean, self.normal, self.shape), (H, b, self.error, self.weight)
        if self.point_normal is None:
            sums = linearise_points(self.points, T, scale_m**2, *surfaces, *results)
        else:
            sums = linearise_planes(self.points, self.point_normal, T, scale_m**2, *surfaces, *results)
        return H, b, _Residuals(*sums)


def _step(H: F8, b: F8, basis: F8) -> F8:
    step: F8 = basis @ np.linalg.lstsq(basis.T @ H @ basis, -basis.T @ b, rcond=1e-12)[0]
    return step


def _with_knowledge(H: F8, b: F8, sigma2: float, known: F8, expected: F8, T: F8) -> tuple[F8, F8]:
    """The normal equations with what was known of the pose before, in units of the residuals' variance."""
    if not np.isfinite(sigma2):
        return H, b
    prior = sigma2 * known
    return H + prior, b + prior @ se3_log(inverse(expected) @ T)


def _small(step: F8) -> bool:
    return bool(
        np.linalg.norm(step[:3]) < ROTATION_STEP_RAD and np.linalg.norm(step[3:]) < TRANSLATION_STEP_M
    )


def _close(a: F8, b: F8, tolerance: float) -> bool:
    turn = a[:3, :3].T @ b[:3, :3]
    w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    way = np.linalg.norm(a[:3, 3] - b[:3, 3])
    return bool(np.linalg.norm(w) < tolerance * ROTATION_STEP_RAD and way < tolerance * TRANSLATION_STEP_M)


def _result(
    T: F8, H: F8, b: F8, residual: _Residuals, partner: _Partners, converged: bool, iterations: int
) -> Registration:
    matched = partner.shape > 0
    points = partner.points
    return Registration(
        T_target_source=T,
        information=H,
        rmse_m=float(np.sqrt(residual.inlier_square / residual.inliers))
        if residual.inliers
        else float("nan"),
        inlier_ratio=residual.inliers / max(len(points), 1),
        converged=converged,
        iterations=iterations,
        sigma2=residual.sigma2,
        gradient=b,
        points=points[matched],
        normals=partner.normal[matched] @ T[:3, :3],
        residuals=partner.error[matched],
        weights=partner.weight[matched],
        normal_variance=partner.normal_variance[matched],
    )


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
