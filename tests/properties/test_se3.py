"""Rigid motions against what defines them, over random angles, near zero and near half a turn."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from scanloom.stages.geometry.interpolation import interpolate_poses
from scanloom.stages.geometry.se3 import (
    adjoint,
    hat,
    inverse,
    matrix_from_quaternion,
    pose,
    quaternion_from_matrix,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform,
    yaw_of,
)

quick = settings(max_examples=60, deadline=None)

unit = st.tuples(*[st.floats(-1, 1) for _ in range(3)]).filter(lambda v: np.linalg.norm(v) > 0.1)
angle = st.one_of(
    st.floats(0, np.pi),
    st.floats(0, 1e-3),
    st.floats(0, 1e-9),
    st.floats(0, 1e-6).map(lambda a: np.pi - a),
    st.just(np.pi),
    st.just(0.0),
)
shift = st.tuples(*[st.floats(-1e3, 1e3) for _ in range(3)]).map(np.array)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    axis = np.array(draw(unit))
    return axis / np.linalg.norm(axis) * draw(angle)


@st.composite
def tangents(draw: st.DrawFn) -> np.ndarray:
    return np.concatenate((draw(rotation_vectors()), draw(shift)))


poses = tangents().map(se3_exp)


@quick
@given(rotation_vectors())
def test_exponential_is_the_rotation(w: np.ndarray) -> None:
    R = so3_exp(w)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


@quick
@given(rotation_vectors())
def test_logarithm_undoes_exponential(w: np.ndarray) -> None:
    back = so3_log(so3_exp(w))
    # At half a turn the axis may point either way.
    either = min(
        np.abs(back - w).max(), np.abs(back + w).max() if np.linalg.norm(w) > np.pi - 1e-7 else np.inf
    )
    assert either < 1e-7 if np.linalg.norm(w) > np.pi - 1e-3 else either < 1e-12
    assert np.linalg.norm(back) <= np.pi + 1e-12


@quick
@given(tangents())
def test_pose_exponential_is_the_matrix_exponential(xi: np.ndarray) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3] = hat(xi[:3])
    generator[:3, 3] = xi[3:]
    np.testing.assert_allclose(se3_exp(xi), expm(generator), atol=1e-10, rtol=1e-11)


@quick
@given(poses)
def test_exponential_undoes_logarithm(T: np.ndarray) -> None:
    np.testing.assert_allclose(se3_exp(se3_log(T)), T, atol=1e-9, rtol=1e-10)


@quick
@given(poses, tangents())
def test_adjoint_moves_a_tangent_through_a_pose(T: np.ndarray, xi: np.ndarray) -> None:
    small = xi * np.array([0.3] * 3 + [1e-3] * 3)
    left = T @ se3_exp(small) @ inverse(T)
    np.testing.assert_allclose(left, se3_exp(adjoint(T) @ small), atol=1e-8)


@quick
@given(poses, poses)
def test_inverse_and_transform_agree_with_matrices(A: np.ndarray, B: np.ndarray) -> None:
    np.testing.assert_allclose(inverse(A) @ A, np.eye(4), atol=1e-10)
    points = np.array([[1.0, 2, 3], [-4, 5, 0.5]])
    np.testing.assert_allclose(transform(A @ B, points), transform(A, transform(B, points)), atol=1e-9)


@quick
@given(rotation_vectors(), st.floats(0.1, 10.0))
def test_quaternions_round_trip(w: np.ndarray, scale: float) -> None:
    R = so3_exp(w)
    q = quaternion_from_matrix(R)
    assert q[0] >= 0
    assert abs(np.linalg.norm(q) - 1) < 1e-14
    np.testing.assert_allclose(matrix_from_quaternion(q * scale), R, atol=1e-14)
    x, y, z, real = Rotation.from_matrix(R).as_quat()
    theirs = np.array([real, x, y, z])
    assert min(np.abs(q - theirs).max(), np.abs(q + theirs).max()) < 1e-12


@quick
@given(st.lists(tangents(), min_size=1, max_size=5))
def test_stacks_equal_single_items(xi: list[np.ndarray]) -> None:
    stack = np.array(xi)
    T = se3_exp(stack)
    for i in range(len(stack)):
        np.testing.assert_allclose(T[i], se3_exp(stack[i]), atol=1e-12)
        np.testing.assert_allclose(adjoint(T)[i], adjoint(T[i]), atol=1e-12)
        np.testing.assert_allclose(
            quaternion_from_matrix(T[:, :3, :3])[i], quaternion_from_matrix(T[i, :3, :3])
        )


@quick
@given(poses, st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_interpolation_follows_constant_motion(T: np.ndarray, rate: float, share: float) -> None:
    """Between two poses a turn about one axis at constant speed is met exactly, and so is a straight line."""
    end = pose(T[:3, :3] @ so3_exp([0, 0, rate]), T[:3, 3] + [3.0, 0, 0])
    stamp = np.array([10, 10 + 1_000_000_000], np.int64)
    at = np.array([10 + round(share * 1e9)], np.int64)
    there = interpolate_poses(stamp, np.array([T, end]), at)[0]
    np.testing.assert_allclose(there[:3, :3], T[:3, :3] @ so3_exp([0, 0, rate * share]), atol=1e-7)
    np.testing.assert_allclose(there[:3, 3], T[:3, 3] + [3.0 * share, 0, 0], atol=1e-7)


@quick
@given(st.lists(tangents(), min_size=1, max_size=6))
def test_interpolation_meets_its_nodes_and_keeps_the_ends(xi: list[np.ndarray]) -> None:
    T = se3_exp(np.array(xi))
    stamp = np.arange(len(T), dtype=np.int64) * 1000
    np.testing.assert_allclose(interpolate_poses(stamp, T, stamp), T, atol=1e-6)
    outside = interpolate_poses(stamp, T, np.array([-500, stamp[-1] + 500]))
    np.testing.assert_allclose(outside, T[[0, -1]], atol=1e-6)


@pytest.mark.parametrize("yaw", [-3.0, -0.5, 0.0, 1.2, 3.14])
def test_yaw_is_the_heading(yaw: float) -> None:
    assert abs(yaw_of(so3_exp([0, 0, yaw])) - yaw) < 1e-12


@given(tangents())
def test_one_pose_gives_what_a_stack_gives(xi):
    """Single poses go through kernels of their own."""
    T = se3_exp(xi)
    assert np.allclose(T, se3_exp(xi[None])[0], rtol=0, atol=1e-12 * (1 + np.abs(xi).max()))
    assert np.allclose(se3_log(T), se3_log(T[None])[0], rtol=0, atol=1e-9 * (1 + np.abs(xi).max()))
    assert np.allclose(inverse(T), inverse(T[None])[0], rtol=0, atol=1e-12 * (1 + np.abs(xi).max()))
