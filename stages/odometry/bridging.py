"""Motions that were guessed, corrected once the scan after them is registered."""

from __future__ import annotations

import numpy as np

from scanloom.stages.geometry.se3 import F8, adjoint, inverse, se3_exp, se3_log

PASSES = 3


def close_gap(T: F8, covariance: F8, T_end: F8, covariance_end: F8) -> tuple[F8, F8]:
    """Poses and covariances of a stretch that was walked with poor steps, now that its end is known.

    Parameters
    ----------
    T : (n + 1, 4, 4) poses; the first is sure, the last is where the end was thought to be.
    covariance : (n, 6, 6) of the n motions between them, right tangent.
    T_end, covariance_end : (4, 4), (6, 6) where the end is, and how well that is known.

    Returns the n + 1 poses that end in `T_end` with the least change of the motions in the sense of their covariances,
    and the covariances of the motions given the end: C_k - C_k A_k^T S^-1 A_k C_k, with A_k the adjoint that carries an
    error of motion k to the end and S = sum A C A^T + covariance_end (a Kalman update of all motions by one measurement).
    """
    motion = inverse(T[:-1]) @ T[1:]
    for _ in range(PASSES):
        A = adjoint(inverse(T[-1]) @ T[1:])
        gain = covariance @ np.swapaxes(A, 1, 2)
        spread = np.einsum("nij,njk->ik", A, gain)
        missing = se3_log(inverse(T[-1]) @ T_end)
        motion = motion @ se3_exp(gain @ np.linalg.solve(spread, missing))
        T = _chained(T[0], motion)
    update = gain @ np.linalg.solve(spread + covariance_end, np.swapaxes(gain, 1, 2))
    after = covariance - update
    T[-1] = T_end
    return T, 0.5 * (after + np.swapaxes(after, 1, 2))


def _chained(T: F8, motion: F8) -> F8:
    out = np.empty((len(motion) + 1, 4, 4))
    out[0] = T
    for k, step in enumerate(motion):
        out[k + 1] = out[k] @ step
    return out
