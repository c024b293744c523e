"""A GNSS outage of a minute through tunnel and field of the sample: what covariances that know of blind directions are worth.

The same odometry, loops and fixes are fused twice: as the product does, and with a fixed covariance per metre of odometry
and no wheels. Fixes of the outage are taken from the log, as if the receiver had reported none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scores import Figure
from scanloom.pipeline.request import Request, SessionInput
from scanloom.pipeline.run import Result, run
from scanloom.pipeline.store import Store
from scanloom.schemas.base import BaseLog
from scanloom.schemas.product import Parts, Product
from scanloom.schemas.tracks import Gnss
from scanloom.schemas.trajectory import Odometry, Poses, Truth
from scanloom.stages.fusion import Settings, fusion
from scanloom.stages.geometry import alignment
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.workflows.map_session import NODES, SIMULATED

SEEDS = (0, 1, 2)
OUTAGE_S = 60.0
FUSION = next(node for node in NODES if node.name == "fusion")
MAKERS = tuple(NODES[: NODES.index(FUSION)])
VARIANTS = {"aware": Settings(), "fixed": Settings(covariance="fixed")}


@dataclasses.dataclass(frozen=True)
class Errors:
    """Distances (n,) to truth after one rigid alignment, m, and which scans lie in the outage."""

    distance_m: np.ndarray
    blanked: np.ndarray


def figures(store: Path) -> Iterator[Figure]:
    """Errors of both variants on every seed, the worst of them, and the ratio of the two."""
    ratios, worst = [], []
    for seed in SEEDS:
        given = _made(seed, store)
        yield from _with_and_without(seed, given)
        errors = {name: _errors(given, settings) for name, settings in VARIANTS.items()}
        for name, e in errors.items():
            yield from _of(f"sample.seed_{seed}.outage_60s.{name}", e)
        ratios.append(alignment.rms(errors["aware"].distance_m) / alignment.rms(errors["fixed"].distance_m))
        worst.append(float(errors["aware"].distance_m[errors["aware"].blanked].max()))
    over = f"over {len(SEEDS)} seeds of the sample"
    yield _map("sample.outage_60s.max_m", max(worst), "m", f"largest error in the outage {over}")
    yield _map(
        "sample.outage_60s.ate_ratio", float(np.mean(ratios)), "", f"ATE aware over fixed, mean {over}"
    )
    yield _map("sample.outage_60s.ate_ratio_worst", max(ratios), "", f"the same, worst {over}")


def _map(name: str, value: float, unit: str, method: str) -> Figure:
    return Figure(name, value, unit, "map", method)


def _of(prefix: str, e: Errors) -> Iterator[Figure]:
    how = (
        f"without the fixes of {OUTAGE_S:g} s around the tunnel; distance to truth after one rigid alignment"
    )
    blanked = e.distance_m[e.blanked]
    yield _map(f"{prefix}.ate_rmse_m", alignment.rms(e.distance_m), "m", f"root mean square: {how}")
    yield _map(
        f"{prefix}.blanked_rmse_m", alignment.rms(blanked), "m", f"root mean square in the outage: {how}"
    )
    yield _map(f"{prefix}.blanked_max_m", float(blanked.max()), "m", f"largest in the outage: {how}")


def _with_and_without(seed: int, given: Mapping[type[Product], Any]) -> Iterator[Figure]:
    for name, length_s in (("with_gnss", 0.0), ("without_gnss", float("inf"))):
        e = _errors(given, Settings(), length_s)
        how = f"{name.replace('_', ' ')}: root mean square distance to truth after one rigid alignment"
        yield _map(f"sample.seed_{seed}.{name}.ate_rmse_m", alignment.rms(e.distance_m), "m", how)


def _errors(given: Mapping[type[Product], Any], settings: Settings, length_s: float = OUTAGE_S) -> Errors:
    odometry: Odometry = given[Odometry][0]
    truth: Truth = given[Truth][0]
    middle_ns = _tunnel_ns(odometry)
    blanked = {**given, Gnss: _without(given[Gnss], middle_ns, length_s)}
    poses = next(
        part.product
        for part in fusion(settings, *[blanked.get(p) for p in FUSION.reads])
        if isinstance(part.product, Poses)
    )
    known = inside(truth.stamp_ns, poses.stamp_ns)
    true = interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, poses.stamp_ns[known])
    near = np.abs(poses.stamp_ns[known] - middle_ns) < 0.5e9 * length_s
    return Errors(alignment.absolute_errors(true, poses.T_world_lidar[known]), near)


def _made(seed: int, store: Path) -> dict[type[Product], Any]:
    """What fusion reads, and the truth, of the sample driven with another seed; taken from the store where it is there."""
    session = SessionInput(
        "sample", {BaseLog: BaseLog()}, {"simulate": {"seed": seed}}, frozenset({SIMULATED})
    )
    result = run(Request(nodes=MAKERS, sessions=(session,)), Store(store))
    for task in result.failures:
        if task.error is not None:
            raise task.error
    written = {product for node in MAKERS for product in node.writes}
    return {product: _parts(result, product) for product in (*FUSION.reads, Truth) if product in written}


def _parts(result: Result, product: type[Product]) -> Any:
    found = Parts([(where, path) for where, path in result.files(product)], load=product.open)
    return found if found and "session" in dict(next(iter(result.files(product)))[0]) else found[0]


def _tunnel_ns(odometry: Odometry) -> int:
    """Middle of the first stretch of a second or more in which registration missed a direction: the tunnel comes before the field."""
    blind = (odometry.direction_p < 0.5).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], blind.astype(int), [0])))).reshape(-1, 2)
    first, last = next((a, b) for a, b in edges if odometry.stamp_ns[b - 1] - odometry.stamp_ns[a] > 1e9)
    return int(odometry.stamp_ns[(first + last) // 2])


def _without(gnss: Parts[Gnss], middle_ns: int, length_s: float) -> Parts[Gnss]:
    changed = []
    for where, fixes in gnss.items():
        off = np.abs(fixes.stamp_ns - middle_ns) < 0.5e9 * length_s
        status = np.where(off, -1, fixes.status).astype(np.int8)
        changed.append((tuple(where.items()), dataclasses.replace(fixes, status=status)))
    return Parts(changed)
