"""Base: where the scans of an earlier map stand, when that map is extended."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict

from scanloom.schemas.base import Base, BaseLog
from scanloom.schemas.errors import InvalidInput
from scanloom.schemas.frames import MAP, WORLD
from scanloom.schemas.trajectory import Poses

VERSION = 1


class Settings(BaseModel):
    """Nothing can be set."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def base(settings: Settings, base_log: BaseLog) -> Base:
    """The poses of a session in the map that is extended; no rows for a session that is new.

    Raises
    ------
    InvalidInput : the trajectory of the map cannot be read, or holds what is no pose.
    """
    name = next((name for name in base_log.names if name.endswith(".parquet")), None)
    if name is None:
        return Base.empty(frame="", georeference=None)
    poses = Poses.open(base_log.path(name))
    _check(poses, str(base_log.path(name)))
    return Base.of(poses)


def _check(poses: Poses, where: str) -> None:
    """Poses of a map: at least one, finite, in order of the scans, in a frame that is known."""
    remade = "make the map again, or extend an earlier version of it"
    if not len(poses):
        raise InvalidInput("holds no pose", where=where, next_step=remade)
    whole = np.isfinite(poses.T_world_lidar).all() and np.isfinite(poses.covariance).all()
    if not whole or (np.diff(poses.scan_index) <= 0).any() or poses.frame not in (MAP, WORLD):
        raise InvalidInput("is not a trajectory that a map holds", where=where, next_step=remade)
