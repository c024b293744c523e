"""Rigid motions: SO(3) and SE(3) exponentials, logarithms, adjoints, quaternions.

Poses are 4x4 matrices `T_a_b` (coordinates of b into a). Tangent vectors are (rotation, translation) on the right,
`T * Exp(xi)`, in the order of GTSAM's Pose3. All functions take single items or stacks with leading dimensions.
Source: Sola, Deray, Atchuthan, "A micro Lie theory", arXiv 1812.01537.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    w, v = tau[..., :3], tau[..., 3:]
    _, b, c = _coefficients(np.linalg.norm(w, axis=-1))
    K = hat(w)
    V = np.eye(3) + b[..., None, None] * K + c[..., None, None] * (K @ K)
    return pose(so3_exp(w), np.einsum("...ij,...j->...i", V, v))


def se3_log(T: ArrayLike) -> F8:
    """Tangent (..., 6) = (rotation, translation) of the pose T (..., 4, 4)."""
    P = _f8(T)
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
