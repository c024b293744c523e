"""Residuals of points against surfaces, linearised: the normal equations of a registration.

Residual of a point p (LiDAR frame) against the surface (mean m, normal n) at its nearest map point:
e = n . (T p - m). With T <- T Exp(xi), xi = (rotation, translation), and u = R^T n: de/dxi = (p x u, u).
The robust weight is Geman-McClure's, w = (k^2 / (k^2 + e^2))^2, as in KISS-ICP (arXiv 2209.15397).

Plane to plane (Segal, Haehnel, Thrun, Generalized-ICP, RSS 2009): e^2 = d . M d with d = T p - m and
M = 2 eps (C(n) + R C(n_p) R^T)^-1, C(n) = 1 - (1 - eps) n n^T; for parallel normals M is n n^T + eps (1 - n n^T).
"""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Float

PLANE_EPSILON = 1e-3
"""Variance across a surface over that along it, of Generalized-ICP."""


@kernel
def linearise_points(
    points: F8, T: F8, scale2: Float, mean: F8, normal: F8, shape: F8, H: F8, b: F8, error: F8, weight: F8
) -> tuple[int, float, float, int, float]:
    """Adds to H (6, 6) and b (6,); notes errors and weights (n,). Returns matches, sum w, sum w e^2, inliers, their sum e^2."""
    J = np.empty(6)
    matches, inliers = 0, 0
    total = square = inlier_square = 0.0
    for n in range(len(points)):
        weight[n] = 0.0
        if shape[n] <= 0.0:
            continue
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        nx, ny, nz = normal[n, 0], normal[n, 1], normal[n, 2]
        e = nx * (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3] - mean[n, 0])
        e += ny * (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3] - mean[n, 1])
        e += nz * (T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3] - mean[n, 2])
        ux = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
        uy = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
        uz = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
        J[0], J[1], J[2] = py * uz - pz * uy, pz * ux - px * uz, px * uy - py * ux
        J[3], J[4], J[5] = ux, uy, uz
        robust = scale2 / (scale2 + e * e)
        w = robust * robust * shape[n]
        error[n], weight[n] = e, w
        matches += 1
        total += w
        square += w * e * e
        if e * e <= scale2:
            inliers += 1
            inlier_square += e * e
        for r in range(6):
            b[r] += w * J[r] * e
            for s in range(r, 6):
                H[r, s] += w * J[r] * J[s]
    for r in range(6):
        for s in range(r):
            H[r, s] = H[s, r]
    return matches, total, square, inliers, inlier_square


@kernel
def linearise_planes(
    points: F8, point_normal: F8, T: F8, scale2: Float, mean: F8, normal: F8, shape: F8, H: F8, b: F8, error: F8,
    weight: F8,
) -> tuple[int, float, float, int, float]:  # fmt: skip
    """As `linearise_points`, plane to plane; all in the frame of the source, where d' = R^T (T p - m), dd'/dxi = (-[p]x, 1)."""
    M, J, MJ, d, Md = np.empty((3, 3)), np.zeros((3, 6)), np.empty((3, 6)), np.empty(3), np.empty(3)
    u, A = np.empty(3), np.empty((3, 3))
    matches, inliers = 0, 0
    total = square = inlier_square = 0.0
    for n in range(len(points)):
        weight[n] = 0.0
        if shape[n] <= 0.0:
            continue
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        for r in range(3):
            u[r] = T[0, r] * normal[n, 0] + T[1, r] * normal[n, 1] + T[2, r] * normal[n, 2]
            # R^T (t - m) + p
            d[r] = T[0, r] * (T[0, 3] - mean[n, 0]) + T[1, r] * (T[1, 3] - mean[n, 1])
            d[r] += T[2, r] * (T[2, 3] - mean[n, 2]) + points[n, r]
        _plane_weight(u, point_normal[n], A, M)
        J[0, 1], J[0, 2], J[1, 0] = pz, -py, -pz
        J[1, 2], J[2, 0], J[2, 1] = px, py, -px
        J[0, 3] = J[1, 4] = J[2, 5] = 1.0
        e2 = 0.0
        for r in range(3):
            Md[r] = M[r, 0] * d[0] + M[r, 1] * d[1] + M[r, 2] * d[2]
            e2 += d[r] * Md[r]
            for c in range(6):
                MJ[r, c] = M[r, 0] * J[0, c] + M[r, 1] * J[1, c] + M[r, 2] * J[2, c]
        robust = scale2 / (scale2 + e2)
        w = robust * robust * shape[n]
        error[n], weight[n] = u[0] * d[0] + u[1] * d[1] + u[2] * d[2], w
        matches += 1
        total += w
        square += w * e2
        if e2 <= scale2:
            inliers += 1
            inlier_square += e2
        for r in range(6):
            b[r] += w * (J[0, r] * Md[0] + J[1, r] * Md[1] + J[2, r] * Md[2])
            for s in range(r, 6):
                H[r, s] += w * (J[0, r] * MJ[0, s] + J[1, r] * MJ[1, s] + J[2, r] * MJ[2, s])
    for r in range(6):
        for s in range(r):
            H[r, s] = H[s, r]
    return matches, total, square, inliers, inlier_square


@kernel
def _plane_weight(u: F8, v: F8, a: F8, M: F8) -> None:
    """M = 2 eps (C(u) + C(v))^-1 for unit normals u and v; a zero v is a point, C = eps, and gives point to plane; `a` is scratch."""
    across = 1.0 - PLANE_EPSILON
    plane = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    base = 2.0 if plane > 0.0 else 1.0 + PLANE_EPSILON
    for r in range(3):
        for c in range(3):
            a[r, c] = -across * (u[r] * u[c] + v[r] * v[c])
        a[r, r] += base
    M[0, 0] = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    M[0, 1] = M[1, 0] = a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]
    M[0, 2] = M[2, 0] = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    M[1, 1] = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]
    M[1, 2] = M[2, 1] = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    M[2, 2] = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    scale = 2.0 * PLANE_EPSILON / (a[0, 0] * M[0, 0] + a[0, 1] * M[1, 0] + a[0, 2] * M[2, 0])
    for r in range(3):
        for c in range(3):
            M[r, c] *= scale
