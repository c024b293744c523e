"""The way of the LiDAR between given times, integrated from angular rates and speeds in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanloom.stages.geometry.kernels import kernel
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.geometry.voxels import Int

I8 = NDArray[np.int64]

LONGEST_STEP_NS = 20_000_000


@kernel
def travel(
    at_ns: I8, reference_ns: Int, first_ns: Int, last_ns: Int, gyro_ns: I8, rate_base: F8, wheel_ns: I8, speed_m_s: F8,
    steady_ns: I8, rate: F8, velocity: F8, point: F8, T_base_lidar: F8,
) -> F8:  # fmt: skip
    """T_reference_t (m, 4, 4) of the LiDAR at the times `at_ns` (m,), all within [first_ns, last_ns].

    gyro_ns, rate_base : (n,), (n, 3) angular rate of the base, rad/s; empty stamps where there is none.
    wheel_ns, speed_m_s : (k,) speed along x of the base, m/s; empty stamps where there is none.
    steady_ns, rate, velocity : (j,), (j, 3), (j, 3), j > 0, in the base frame; they take the place of what is missing.
    point : (3,) where in the base frame the speed or velocity is measured, m.

    R_{k+1} = R_k Exp(w dt), p_{k+1} = p_k + R_k Exp(w dt / 2) v dt with the mean w, v of the two ends (methods 1.4).
    Without motion every pose is the identity, exactly.
    """
    node_ns = _nodes(at_ns, reference_ns, first_ns, last_ns, gyro_ns, wheel_ns)
    n = len(node_ns)
    rates, velocities = np.zeros((n, 3)), np.zeros((n, 3))
    has_gyro, has_wheel = len(gyro_ns) > 0, len(wheel_ns) > 0
    _interpolate(gyro_ns if has_gyro else steady_ns, rate_base if has_gyro else rate, node_ns, rates)
    if has_wheel:
        _interpolate(wheel_ns, speed_m_s.reshape(-1, 1), node_ns, velocities)
    else:
        _interpolate(steady_ns, velocity, node_ns, velocities)
    _to_origin(rates, point, velocities)
    R, p = np.zeros((n, 3, 3)), np.zeros((n, 3))
    R[0, 0, 0] = R[0, 1, 1] = R[0, 2, 2] = 1.0
    half = np.empty((3, 3))
    for k in range(n - 1):
        _step(1e-9 * (node_ns[k + 1] - node_ns[k]), rates, velocities, k, half, R, p)
    return _seen_from_lidar(
        np.searchsorted(node_ns, at_ns), np.searchsorted(node_ns, reference_ns), R, p, T_base_lidar
    )


@kernel
def _nodes(at_ns: I8, reference_ns: Int, first_ns: Int, last_ns: Int, gyro_ns: I8, wheel_ns: I8) -> I8:
    """Times at which the motion is evaluated: those asked for, the measurements, and none far apart."""
    gyro = gyro_ns[np.searchsorted(gyro_ns, first_ns) : np.searchsorted(gyro_ns, last_ns, side="right")]
    wheel = wheel_ns[np.searchsorted(wheel_ns, first_ns) : np.searchsorted(wheel_ns, last_ns, side="right")]
    steps = (last_ns - first_ns) // LONGEST_STEP_NS + 1
    m, g, w = len(at_ns), len(gyro), len(wheel)
    node = np.empty(m + g + w + steps + 1, np.int64)
    node[:m], node[m : m + g], node[m + g : m + g + w] = at_ns, gyro, wheel
    for k in range(steps):
        node[m + g + w + k] = first_ns + k * LONGEST_STEP_NS
    node[-1] = reference_ns
    node.sort()
    kept = 1
    for k in range(1, len(node)):
        if node[k] != node[kept - 1]:
            node[kept] = node[k]
            kept += 1
    return node[:kept].copy()


@kernel
def _interpolate(stamp_ns: I8, value: F8, at_ns: I8, out: F8) -> None:
    """Values (k, c) at increasing times (k,), linear between samples (n, c); beyond them the ends are held."""
    i: Int = max(np.searchsorted(stamp_ns, at_ns[0], side="right") - 1, 0)
    for k in range(len(at_ns)):
        i, share = _place(stamp_ns, i, at_ns[k])
        after = min(i + 1, len(stamp_ns) - 1)
        for c in range(value.shape[1]):
            out[k, c] = value[i, c] + share * (value[after, c] - value[i, c])


@kernel
def _to_origin(rates: F8, point: F8, velocities: F8) -> None:
    """From the velocity of a point of the base to that of its origin: v - w x point, in place."""
    for k in range(len(rates)):
        x, y, z = rates[k, 0], rates[k, 1], rates[k, 2]
        velocities[k, 0] -= y * point[2] - z * point[1]
        velocities[k, 1] -= z * point[0] - x * point[2]
        velocities[k, 2] -= x * point[1] - y * point[0]


@kernel
def _place(stamp_ns: I8, i: Int, at_ns: Int) -> tuple[Int, float]:
    """Sample at or before a time, from sample i on, and the share of the way to the next one."""
    while i + 1 < len(stamp_ns) and stamp_ns[i + 1] <= at_ns:
        i += 1
    if i + 1 >= len(stamp_ns) or at_ns <= stamp_ns[i]:
        return i, 0.0
    return i, (at_ns - stamp_ns[i]) / (stamp_ns[i + 1] - stamp_ns[i])


@kernel
def _step(dt: float, rates: F8, velocities: F8, k: Int, half: F8, R: F8, p: F8) -> None:
    """Pose k + 1 from pose k: half of the rotation, the displacement, the other half."""
    _exp(
        0.25 * dt * (rates[k, 0] + rates[k + 1, 0]),
        0.25 * dt * (rates[k, 1] + rates[k + 1, 1]),
        0.25 * dt * (rates[k, 2] + rates[k + 1, 2]),
        half,
    )
    for i in range(3):
        p[k + 1, i] = p[k, i]
        for j in range(3):
            middle = R[k, i, 0] * half[0, j] + R[k, i, 1] * half[1, j] + R[k, i, 2] * half[2, j]
            p[k + 1, i] += middle * 0.5 * dt * (velocities[k, j] + velocities[k + 1, j])
            R[k + 1, i, j] = middle
    for i in range(3):
        a, b, c = R[k + 1, i, 0], R[k + 1, i, 1], R[k + 1, i, 2]
        for j in range(3):
            R[k + 1, i, j] = a * half[0, j] + b * half[1, j] + c * half[2, j]


@kernel
def _exp(x: float, y: float, z: float, out: F8) -> None:
    """Rotation matrix (3, 3) of the rotation vector (x, y, z), rad: 1 + sin(t) / t K + (1 - cos t) / t^2 K^2."""
    t2 = x * x + y * y + z * z
    t = np.sqrt(t2)
    a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    if t > 1e-4:
        a, b = np.sin(t) / t, 2.0 * np.sin(0.5 * t) ** 2 / t2
    out[0, 0], out[1, 1], out[2, 2] = (
        1.0 - b * (y * y + z * z),
        1.0 - b * (x * x + z * z),
        1.0 - b * (x * x + y * y),
    )
    out[0, 1], out[1, 0] = b * x * y - a * z, b * x * y + a * z
    out[0, 2], out[2, 0] = b * x * z + a * y, b * x * z - a * y
    out[1, 2], out[2, 1] = b * y * z - a * x, b * y * z + a * x


@kernel
def _seen_from_lidar(rows: NDArray[np.int64], reference: Int, R: F8, p: F8, T_base_lidar: F8) -> F8:
    """1 + T_lidar_base (T_reference_t - 1) T_base_lidar, so that no motion gives no rounding either."""
    L, lever = T_base_lidar[:3, :3], T_base_lidar[:3, 3]
    out = np.zeros((len(rows), 4, 4))
    D, E = np.empty((3, 4)), np.empty((3, 4))
    for n in range(len(rows)):
        k = rows[n]
        for i in range(3):
            for j in range(3):
                D[i, j] = 0.0
                for m in range(3):
                    D[i, j] += R[reference, m, i] * R[k, m, j]
            D[i, 3] = 0.0
            for m in range(3):
                D[i, 3] += R[reference, m, i] * (p[k, m] - p[reference, m])
            D[i, i] -= 1.0
        for i in range(3):
            for j in range(3):
                E[i, j] = D[i, 0] * L[0, j] + D[i, 1] * L[1, j] + D[i, 2] * L[2, j]
            E[i, 3] = D[i, 0] * lever[0] + D[i, 1] * lever[1] + D[i, 2] * lever[2] + D[i, 3]
        for i in range(3):
            for j in range(4):
                out[n, i, j] = L[0, i] * E[0, j] + L[1, i] * E[1, j] + L[2, i] * E[2, j]
            out[n, i, i] += 1.0
        out[n, 3, 3] = 1.0
    return out
