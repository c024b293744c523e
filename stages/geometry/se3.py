"""Rigid motions: SO(3) and SE(3) exponentials, logarithms, adjoints, quaternions.

Poses are 4x4 matrices `T_a_b` (coordinates of b into a). Tangent vectors are (rotation, translation) on the right,
`T * Exp(xi)`, in the order of GTSAM's Pose3. All functions take single items or stacks with leading dimensions.
Source: Sola, Deray, Atchuthan, "A micro Lie theory", arXiv 1812.01537.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scanloom.stages.geometry.kernels import kernel

F8 = NDArray[np.float64]
_SMALL = 1e-8


def _f8(values: ArrayLike) -> F8:
    return np.asarray(values, np.float64)


def hat(w: ArrayLike) -> F8:
    """Skew matrix (..., 3, 3) with hat(w) @ v = w x v."""
    omega = _f8(w)
    out = np.zeros((*omega.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -omega[..., 2], omega[..., 1]
    out[..., 1, 0], out[..., 1, 2] = omega[..., 2], -omega[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -omega[..., 1], omega[..., 0]
    return out


def _coefficients(angle: F8) -> tuple[F8, F8, F8]:
    """sin(t)/t, (1 - cos t)/t^2, (t - sin t)/t^3, with their series near zero."""
    small = angle < 1e-4
    t = np.where(small, 1.0, angle)
    a = np.where(small, 1 - angle**2 / 6, np.sin(t) / t)
    b = np.where(small, 0.5 - angle**2 / 24, 2 * np.sin(t / 2) ** 2 / t**2)
    c = np.where(small, 1 / 6 - angle**2 / 120, (t - np.sin(t)) / t**3)
    return a, b, c


def so3_exp(w: ArrayLike) -> F8:
    """Rotation matrix (..., 3, 3) of the rotation vector w (..., 3), rad."""
    omega = _f8(w)
    a, b, _ = _coefficients(np.linalg.norm(omega, axis=-1))
    K = hat(omega)
    return np.eye(3) + a[..., None, None] * K + b[..., None, None] * (K @ K)


def so3_log(R: ArrayLike) -> F8:
    """Rotation vector (..., 3), rad, of norm at most pi."""
    q = quaternion_from_matrix(R)
    vector = q[..., 1:]
    sine = np.linalg.norm(vector, axis=-1)
    angle = 2 * np.arctan2(sine, q[..., 0])
    scale = np.where(
        sine < _SMALL, 2.0 / np.maximum(q[..., 0], _SMALL), angle / np.where(sine < _SMALL, 1.0, sine)
    )
    return vector * scale[..., None]


def se3_exp(xi: ArrayLike) -> F8:
    """Pose (..., 4, 4) of the tangent xi (..., 6) = (rotation, translation)."""
    tau = _f8(xi)
    if tau.ndim == 1:
        return _exp(np.ascontiguousarray(tau))
    w, v = tau[..., :3], tau[..., 3:]
    _, b, c = _coefficients(np.linalg.norm(w, axis=-1))
    K = hat(w)
    V = np.eye(3) + b[..., None, None] * K + c[..., None, None] * (K @ K)
    return pose(so3_exp(w), np.einsum("...ij,...j->...i", V, v))


def se3_log(T: ArrayLike) -> F8:
    """Tangent (..., 6) = (rotation, translation) of the pose T (..., 4, 4)."""
    P = _f8(T)
    if P.ndim == 2:
        return _log(np.ascontiguousarray(P))
    w = so3_log(P[..., :3, :3])
    _, b, c = _coefficients(np.linalg.norm(w, axis=-1))
    K = hat(w)
    V = np.eye(3) + b[..., None, None] * K + c[..., None, None] * (K @ K)
    v = np.linalg.solve(V, P[..., :3, 3:])[..., 0]
    return np.concatenate((w, v), axis=-1)


def pose(R: ArrayLike, t: ArrayLike) -> F8:
    """Pose (..., 4, 4) from rotation (..., 3, 3) and translation (..., 3), m."""
    M, p = _f8(R), _f8(t)
    out = np.zeros((*np.broadcast_shapes(M.shape[:-2], p.shape[:-1]), 4, 4))
    out[..., :3, :3] = M
    out[..., :3, 3] = p
    out[..., 3, 3] = 1.0
    return out


def inverse(T: ArrayLike) -> F8:
    """Inverse pose (..., 4, 4)."""
    P = _f8(T)
    if P.ndim == 2:
        return _inverse(np.ascontiguousarray(P))
    Rt = np.swapaxes(P[..., :3, :3], -1, -2)
    return pose(Rt, -np.einsum("...ij,...j->...i", Rt, P[..., :3, 3]))


def transform(T: ArrayLike, points: ArrayLike) -> F8:
    """Points (n, 3) of frame b in frame a, for one pose T_a_b (4, 4)."""
    P = _f8(T)
    return np.asarray(points, float) @ P[:3, :3].T + P[:3, 3]


def adjoint(T: ArrayLike) -> F8:
    """Ad(T) (..., 6, 6): T Exp(xi) T^-1 = Exp(Ad(T) xi), order (rotation, translation)."""
    P = _f8(T)
    R = P[..., :3, :3]
    out = np.zeros((*P.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(P[..., :3, 3]) @ R
    return out


def quaternion_from_matrix(R: ArrayLike) -> F8:
    """Unit quaternion (..., 4) as qw, qx, qy, qz with qw >= 0 (Shepperd's method: the largest term is the pivot)."""
    M = _f8(R)
    m00, m11, m22 = M[..., 0, 0], M[..., 1, 1], M[..., 2, 2]
    squares = np.stack(
        (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), -1
    )
    xy, xz, yz = M[..., 1, 0] + M[..., 0, 1], M[..., 0, 2] + M[..., 2, 0], M[..., 2, 1] + M[..., 1, 2]
    dx, dy, dz = M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]
    rows = np.stack(
        (
            np.stack((squares[..., 0], dx, dy, dz), -1),
            np.stack((dx, squares[..., 1], xy, xz), -1),
            np.stack((dy, xy, squares[..., 2], yz), -1),
            np.stack((dz, xz, yz, squares[..., 3]), -1),
        ),
        -2,
    )
    pivot = np.argmax(squares, axis=-1)
    q = np.take_along_axis(rows, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return _f8(np.where(q[..., :1] < 0, -q, q))


# ---------------------------------------------------------------------------------------------------------------------
# Single poses, of which a registration handles dozens: a tenth of a millisecond each in array operations.


@kernel
def _exp(tau: F8) -> F8:
    """`se3_exp` of one tangent (6,)."""
    K, T = np.zeros((3, 3)), np.zeros((4, 4))
    K[0, 1], K[0, 2], K[1, 2] = -tau[2], tau[1], -tau[0]
    K[1, 0], K[2, 0], K[2, 1] = tau[2], -tau[1], tau[0]
    t2 = tau[0] ** 2 + tau[1] ** 2 + tau[2] ** 2
    t = np.sqrt(t2)
    a, b, c = 1 - t2 / 6, 0.5 - t2 / 24, 1 / 6 - t2 / 120
    if t >= 1e-4:
        a, b, c = np.sin(t) / t, 2 * np.sin(t / 2) ** 2 / t2, (t - np.sin(t)) / (t2 * t)
    for i in range(3):
        for j in range(3):
            square = K[i, 0] * K[0, j] + K[i, 1] * K[1, j] + K[i, 2] * K[2, j]
            unit = 1.0 if i == j else 0.0
            T[i, j] = unit + a * K[i, j] + b * square
            T[i, 3] += (unit + b * K[i, j] + c * square) * tau[3 + j]
    T[3, 3] = 1.0
    return T


@kernel
def _log(T: F8) -> F8:
    """`se3_log` of one pose (4, 4); V^-1 = I - K/2 + d K^2 in closed form."""
    q = np.empty(4)
    trace = T[0, 0] + T[1, 1] + T[2, 2]
    pivot, most = 0, 1 + trace
    for k in range(3):
        if 1 + 2 * T[k, k] - trace > most:
            pivot, most = k + 1, 1 + 2 * T[k, k] - trace
    if pivot == 0:
        q[0] = most
        q[1], q[2], q[3] = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
    else:
        i = pivot - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0], q[1 + i] = T[k, j] - T[j, k], most
        q[1 + j], q[1 + k] = T[j, i] + T[i, j], T[k, i] + T[i, k]
    norm = np.sqrt((q**2).sum()) * (-1.0 if q[0] < 0 else 1.0)
    q /= norm
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    angle = 2 * np.arctan2(sine, q[0])
    scale = angle / sine if sine >= _SMALL else 2.0
    wx, wy, wz = q[1] * scale, q[2] * scale, q[3] * scale
    t2 = angle * angle
    d = 1 / 12 + t2 / 720
    if angle >= 1e-3:
        d = (1 - 0.5 * angle * np.sin(angle) / (2 * np.sin(angle / 2) ** 2)) / t2
    x, y, z = T[0, 3], T[1, 3], T[2, 3]
    kx, ky, kz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    out = np.empty(6)
    out[0], out[1], out[2] = wx, wy, wz
    out[3] = x - 0.5 * kx + d * (wy * kz - wz * ky)
    out[4] = y - 0.5 * ky + d * (wz * kx - wx * kz)
    out[5] = z - 0.5 * kz + d * (wx * ky - wy * kx)
    return out


@kernel
def _inverse(T: F8) -> F8:
    """`inverse` of one pose (4, 4)."""
    out = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            out[i, j] = T[j, i]
            out[i, 3] -= T[j, i] * T[j, 3]
    out[3, 3] = 1.0
    return out


def matrix_from_quaternion(q: ArrayLike) -> F8:
    """Rotation (..., 3, 3) of the quaternion (..., 4) as qw, qx, qy, qz; it need not be normalised."""
    u = _f8(q)
    u = u / np.linalg.norm(u, axis=-1, keepdims=True)
    w, v = u[..., 0], u[..., 1:]
    K = hat(v)
    R: F8 = np.eye(3) + 2 * w[..., None, None] * K + 2 * (K @ K)
    return R


def yaw_of(T: ArrayLike) -> F8:
    """Heading of a pose or rotation, rad in (-pi, pi], 0 along x, counter-clockwise."""
    P = _f8(T)
    heading: F8 = np.arctan2(P[..., 1, 0], P[..., 0, 0])
    return heading
