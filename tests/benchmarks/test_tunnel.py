"""What counts as a flag, and what as inside."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.systems import Outcome
from benchmarks.tunnel import PORTAL_M, TUNNEL, axis_flagged, error_percent, stretch
from scanloom.schemas.trajectory import Truth
from scanloom.stages.geometry.se3 import pose, so3_exp

FORWARD = np.array([1.0, 0.0, 0.0])
LEAST_P = 0.9


def seen(p: float, direction: list[float]) -> Outcome:
    """One scan whose least observed direction is the given one."""
    column = np.array(direction, float) / np.linalg.norm(direction)
    directions = np.eye(6)
    directions[:, 2] = column
    return Outcome(
        np.zeros(1, np.int64), np.eye(4)[None], np.ones(1), 1.0, 1,
        {"direction_p": np.array([[1.0, 1.0, p, 1.0, 1.0, 1.0]]), "weak_directions": directions[None]},
    )  # fmt: skip


def tilted(degrees: float) -> list[float]:
    return [0, 0, 0, np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0]


@pytest.mark.parametrize(
    "outcome, flagged",
    [
        (seen(0.1, tilted(0)), True),
        (seen(0.1, tilted(180)), True),  # an eigenvector has no sign
        (seen(0.1, tilted(14)), True),
        (seen(0.1, tilted(16)), False),
        (seen(0.89, tilted(0)), True),
        (seen(0.9, tilted(0)), False),
        (seen(0.1, [0, 0, 1.1, 1, 0, 0]), False),  # more rotation than translation
        (seen(0.1, [0, 0, 0.9, 1, 0, 0]), True),
    ],
)
def test_axis_is_flagged(outcome: Outcome, flagged: bool) -> None:
    assert axis_flagged(outcome, FORWARD, LEAST_P).tolist() == [flagged]


def drive() -> np.ndarray:
    x = np.arange(TUNNEL[0] - 65.0, TUNNEL[1] + 65.0, 1.0)
    return pose(np.eye(3), np.column_stack((x, 0 * x - 1.7, 0 * x)))


def test_inside_is_well_inside() -> None:
    T = drive()
    where = stretch(T)
    x = T[:, 0, 3]
    assert x[where.inside].min() == pytest.approx(TUNNEL[0] + PORTAL_M, abs=1.01)
    assert x[where.inside].max() == pytest.approx(TUNNEL[1] - PORTAL_M, abs=1.01)
    assert x[where.outside].max() < TUNNEL[0]
    assert not (where.inside & where.outside).any()
    aside = T @ pose(np.eye(3), [0.0, 40.0, 0.0])
    assert not stretch(aside).inside.any()


def test_error_through_the_tunnel_is_a_share_of_its_length() -> None:
    T = drive()
    stamps = 10**18 + 10**8 * np.arange(len(T))
    short = pose(np.eye(3), T[:, :3, 3] * 0.99)
    turned = pose(so3_exp([0, 0, 0.4]), np.zeros(3)) @ short
    outcome = Outcome(stamps, turned, np.ones(len(T)), 1.0, 1)
    assert error_percent(Truth(stamps, T, "exact"), outcome) == pytest.approx(1.0, abs=0.03)
