"""The pose graph after optimisation: every factor with what became of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Table, attribute, column


@dataclass(frozen=True)
class Graph(Table):
    """One row per factor. Keys name keyframes as `session/scan_index`.

    Every fix of a session has its row of kind `gnss`, in the order of the fixes, used or not.
    """

    NAME: ClassVar[str] = "graph"

    kind: NDArray[np.object_] = column(
        "str",
        "`odometry`, `wheel`, `loop`, `gnss`, `gravity`, `base` (a pose of the map that is extended) or `prior`",
    )
    key_i: NDArray[np.object_] = column("str", "first pose")
    key_j: NDArray[np.object_] = column("str", "second pose; empty for a factor on one pose")
    measurement: NDArray[np.float64] = column(
        "f8",
        "relative pose of a between factor; for gnss the position in the last column",
        unit="m",
        shape=(4, 4),
    )
    covariance: NDArray[np.float64] = column(
        "f8", "order (rotation, translation); unused rows are zero", shape=(6, 6)
    )
    residual_before: NDArray[np.float64] = column("f8", "whitened norm at the initial values")
    residual_after: NDArray[np.float64] = column("f8", "whitened norm at the solution")
    residual_m: NDArray[np.float64] = column(
        "f8",
        "gnss: antenna at the solution minus the fix; NaN for other kinds and without a fix",
        unit="m",
        shape=(3,),
        frame="world or map",
    )
    weight: NDArray[np.float64] = column("f8", "final robust weight, 0 switched off to 1 trusted")
    verdict: NDArray[np.object_] = column("str", "`used`, or why it was left out")
    remarks: Sequence[str] = attribute(
        "what a user should know of the map's making, in sentences", default=()
    )
    warnings: Sequence[str] = attribute("what casts doubt on a part of the map, in sentences", default=())
