"""Clean: which voxels of a tile held something that passed, left, or changed between sessions.

All that the rays of all chunks and sessions say of a tile is added up in the order of time. What a session met in a voxel
moved if its own rays saw through the voxel at other times; it has changed if those of later sessions did. Labels only: what is
to become of such points is decided in tiling. One tile needs no other; memory is bounded by the tile and its sessions are
gone through one by one. Source: methods 1.5.1 (free-space conflict).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from scanloom.schemas.clean import BRICK_SIDE, BRICK_VOXELS, Cleared, Rays, Standing
from scanloom.schemas.errors import StageError
from scanloom.schemas.product import Part, Parts
from scanloom.stages.clean.evidence import MOST, U2, Evidence, all_bricks
from scanloom.stages.clean.tiles import brick_indices
from scanloom.stages.clean.verdicts import U1, judge_later, judge_own

VERSION = 1


class Settings(BaseModel):
    """When what was met in a voxel counts as gone."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seen_through: float = Field(
        1.0, ge=0.0, le=100.0, description="moved: seen through this many times as often as met, ratio"
    )
    left_bins: int = Field(
        5,
        ge=1,
        le=1000,
        description="stood and left: seen through in so many bins before or after it was met",
    )
    flicker: float = Field(
        0.1, ge=0.0, le=1.0, description="stood and left: free bins between hits over those outside, at most"
    )
    arrived_bins: int = Field(
        25,
        ge=1,
        le=10000,
        description="stands: came, was met in so many bins and was never seen to be gone again",
    )
    stands_share: float = Field(
        0.3, ge=0.0, le=1.0, description="stands: seen through at most this many times as often as met, ratio"
    )
    stands_bins: int = Field(2, ge=1, le=1000, description="stands: met in at least so many bins")
    tracked_share: float = Field(
        0.5,
        ge=0.0,
        le=1.0,
        description="moved: this share of the bins that met something met what the tracker saw move",
    )
    changed_bins: int = Field(
        5, ge=1, le=1000, description="changed: later sessions saw through it in so many bins"
    )
    changed_hits: float = Field(
        0.05,
        ge=0.0,
        le=1.0,
        description="changed: bins of later sessions that met something over free ones, at most",
    )


def clean(settings: Settings, rays: Parts[Rays]) -> Iterator[Part[Cleared]]:
    """Verdicts on the voxels of one tile for each session that passed it, the latest first.

    Raises
    ------
    StageError : no ray crosses the tile.
    """
    if not len(rays):
        raise StageError(
            "no ray crosses this tile", next_step="run rays first; it names the tiles that are seen"
        )
    grid, bricks, order = _surveyed(rays)
    later = np.zeros((2, len(bricks), BRICK_VOXELS), np.uint32)
    for session, numbers in order.items():
        evidence = _evidence(bricks, rays, numbers)
        verdict = _own(settings, evidence)
        _changed(settings, evidence, verdict, later)
        later[0] += evidence.hits
        later[1] += evidence.through
        _only_own(grid, bricks, verdict)
        yield Part(_cleared(grid, evidence, verdict), session)


class _Grid(NamedTuple):
    """Where the voxels of a tile lie."""

    tile: tuple[int, int]
    voxel_size_m: float
    tile_size_m: float


def _surveyed(rays: Parts[Rays]) -> tuple[_Grid, np.ndarray, dict[str, list[int]]]:
    """The grid; the bricks of all parts; numbers of the parts of each session, chunk by chunk in the order of time, the
    session that came last first. Each part is read once."""
    bricks: list[np.ndarray] = []
    numbers: dict[str, list[int]] = {}
    first_ns: dict[str, int] = {}
    for n, (where, part) in enumerate(rays.items()):
        bricks.append(part.brick)
        numbers.setdefault(where["session"], []).append(n)
        first_ns.setdefault(where["session"], part.first_ns)
    x, y = (int(word) for word in where["tile"].split("_"))
    latest_first = sorted(numbers, key=lambda session: (-first_ns[session], session))
    grid = _Grid((x, y), part.voxel_size_m, part.tile_size_m)
    return grid, all_bricks(bricks), {session: numbers[session] for session in latest_first}


def _evidence(bricks: np.ndarray, rays: Parts[Rays], numbers: list[int]) -> Evidence:
    evidence = Evidence.of(bricks)
    for n in numbers:
        evidence.add(rays[n])
    return evidence


def _own(settings: Settings, evidence: Evidence) -> U1:
    limits = np.array(
        [settings.seen_through, settings.left_bins, settings.flicker, settings.arrived_bins, settings.stands_share,
         settings.stands_bins, settings.tracked_share], float,
    )  # fmt: skip
    verdict: U1 = judge_own(
        evidence.bricks, evidence.keys, evidence.rows, evidence.hits, evidence.tracked, evidence.through,
        evidence.between, evidence.after, limits,
    )  # fmt: skip
    return verdict


def _changed(settings: Settings, evidence: Evidence, verdict: U1, later: np.ndarray) -> None:
    judge_later(
        evidence.bricks, evidence.keys, evidence.rows, verdict, evidence.hits, _capped(later[0]), _capped(later[1]),
        settings.changed_bins, settings.changed_hits,
    )  # fmt: skip


def _capped(counts: np.ndarray) -> U2:
    capped: U2 = np.minimum(counts, MOST).astype(np.uint16)
    return capped


def _only_own(grid: _Grid, bricks: np.ndarray, verdict: U1) -> None:
    """Leave what lies in the bricks but not in the tile to its neighbours."""
    first = brick_indices(bricks)[:, :2] * BRICK_SIDE
    cube = verdict.reshape(-1, BRICK_SIDE, BRICK_SIDE, BRICK_SIDE)
    for axis in range(2):
        corner_m = grid.tile[axis] * grid.tile_size_m
        middle_m = (first[:, axis, None] + np.arange(BRICK_SIDE) + 0.5) * grid.voxel_size_m
        beyond = (middle_m < corner_m) | (middle_m >= corner_m + grid.tile_size_m)
        shape = (-1, BRICK_SIDE, 1, 1) if axis == 0 else (-1, 1, BRICK_SIDE, 1)
        cube[np.broadcast_to(beyond.reshape(shape), cube.shape)] = Standing.UNKNOWN


def _cleared(grid: _Grid, evidence: Evidence, verdict: U1) -> Cleared:
    told = np.flatnonzero((verdict != Standing.UNKNOWN).any(axis=1))
    return Cleared(
        brick=evidence.bricks[told], verdict=verdict[told],
        voxel_size_m=grid.voxel_size_m, tile_size_m=grid.tile_size_m,
    )  # fmt: skip
