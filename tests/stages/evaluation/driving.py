"""Drives around a circle and their evaluation, by known truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from scanloom.schemas.evaluation import Metrics
from scanloom.schemas.loops import Loops
from scanloom.schemas.pose_graph import Graph
from scanloom.schemas.product import Parts
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Truth
from scanloom.stages.evaluation import evaluation
from scanloom.stages.evaluation.stage import Settings
from scanloom.stages.geometry.geodesy import georeference
from scanloom.stages.geometry.se3 import F8, pose
from tests.stages.mapping import (
    circle,
    graph_of,
    odometry_of,
    one,
    poses_of,
    session_of,
    truth_of,
)

HERE = georeference(48.137, 11.576, 560.0)
LAP = 503
"""Scans of one lap of `laps`."""
ARC = 400
"""Scans of an arc that does not come back to its start."""


def laps(count: int = 1000, beside_m: float = 0.0) -> F8:
    """A metre a scan around a circle; `beside_m` farther out."""
    return circle(count) @ pose(np.eye(3), [0.0, -beside_m, 0.0])


def figures_of(**given: Any) -> dict[str, float]:
    return dict(zip(*(getattr(metrics_of(**given), name) for name in ("name", "value"))))


def metrics_of(
    *, T: F8 | dict[str, F8], loops: Loops | None = None, graph: Graph | None = None, gnss: Gnss | None = None,
    truth: dict[str, Truth] | None = None, poses: dict[str, Any] | None = None, odometry: Any = None,
) -> Metrics:  # fmt: skip
    """Sessions that drove T, by the truth given, else exactly."""
    paths = T if isinstance(T, dict) else {"a": T}
    loops = Loops.empty() if loops is None else loops

    def parts(products: dict[str, Any]) -> Parts[Any]:
        return Parts([((("session", name),), product) for name, product in products.items()])

    *_, metrics = evaluation(
        Settings(), parts({n: session_of(n) for n in paths}),
        parts({n: truth_of(t) for n, t in paths.items()} if truth is None else truth),
        parts({n: odometry_of(t) for n, t in paths.items()}) if odometry is None else one(odometry),
        parts({n: poses_of(t) for n, t in paths.items()} if poses is None else poses),
        loops, graph_of(loops) if graph is None else graph, one(Gnss.empty() if gnss is None else gnss), Parts([]),
    )  # fmt: skip
    assert isinstance(metrics, Metrics)
    return metrics
