"""The systems that clean: which points of a scene each keeps, and how long it takes. All get the same points and poses.

DUFOMap (Duberg, Zhang, Jia, Jensfelt, RA-L 2024) runs with the parameters its authors publish for all sensors: voxels of
0.1 m, d_s 0.2 m, hits extended, d_p 1 (the paper, the repository's configuration) or 2 (its Python example). The first does
better in our scenes; where both are run the better one stands for the system.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path

import numpy as np

from benchmarks.clean_nearness import Mask
from benchmarks.clean_ours import PROCESSES, Settings, apart, cleaned
from benchmarks.clean_scenes import Scene
from benchmarks.clean_scores import STANDING
from scanloom import stages

THREADS = 2
RESOLUTION_M, INFLATED_HITS_M = 0.1, 0.2
OURS, PEER = "scanloom", "dufomap"


@dataclass(frozen=True)
class Outcome:
    """What a system says of a scene."""

    kept: Mask
    """(n,) points that stay in the map."""
    ms_per_scan: float
    """Wall time over all scans; NaN for what only reads labels."""
    how: str


@dataclass(frozen=True)
class System:
    """One way to clean."""

    name: str
    variants: tuple[str, ...]
    """The best by associated accuracy stands for the system."""
    run: Callable[[Scene, str, str, Settings], Outcome]
    version: Callable[[], str]
    """Empty where the system is not installed; outcomes are kept under it."""
    ours: bool = False
    """Reads more than points and poses, and has settings."""


def classify(
    system: System, variant: str, scene: Scene, poses: str, settings: Settings, fresh: bool
) -> Outcome:
    """Run a system, unless the same version has said before what it keeps of the scene; `fresh` runs it again."""
    more = f"{scene.folder.name}-{_short(settings)}-" if system.ours else ""
    read = f"{more}{scene.inputs[poses]}"
    path = scene.folder.parent / "outcomes" / f"{system.name}-{variant}-{read}-{system.version()}.npz"
    path.parent.mkdir(exist_ok=True)
    if fresh or not path.exists():
        found = system.run(scene, poses, variant, settings)
        bits = np.packbits(found.kept)
        np.savez(path, kept=bits, ms_per_scan=found.ms_per_scan, how=found.how)
    with np.load(path) as file:
        kept = np.unpackbits(file["kept"], count=len(scene.points)).astype(np.bool_)
        return Outcome(kept, float(file["ms_per_scan"]), str(file["how"]))


def _short(settings: Settings) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]


def _everything(scene: Scene, poses: str, variant: str, settings: Settings) -> Outcome:
    return Outcome(np.ones(len(scene.points), np.bool_), float("nan"), "every point stays")


def _denoised(scene: Scene, poses: str, variant: str, settings: Settings) -> Outcome:
    return Outcome(np.isin(scene.labels, STANDING), float("nan"), "labels of denoise alone")


def _dufomap(scene: Scene, poses: str, variant: str, settings: Settings) -> Outcome:
    return apart(lambda: _integrated(scene, poses, variant))


def _integrated(scene: Scene, poses: str, variant: str) -> Outcome:
    """Integration, propagation and the segmentation of every scan; reading is no part of the time."""
    from dufomap import dufomap

    inflated = int(variant.removeprefix("d_p_"))
    system = dufomap(RESOLUTION_M, INFLATED_HITS_M, inflated, num_threads=THREADS, hit_extension=True)
    T = np.array(scene.poses[poses])
    scans = [np.array(scene.points[scene.scan(k)]) for k in range(len(scene))]
    started = time.perf_counter()
    for points, pose in zip(scans, T):
        system.run(points, pose, cloud_transform=True)
    system.oncePropagateCluster(if_propagate=True, if_cluster=False)
    moving = [system.segment(points, pose, cloud_transform=True) for points, pose in zip(scans, T)]
    ms = 1e3 * (time.perf_counter() - started) / len(scene)
    return Outcome(np.concatenate(moving) == 0, ms, f"d_p {inflated}, {THREADS} threads")


def _ours(scene: Scene, poses: str, variant: str, settings: Settings) -> Outcome:
    classes, ms = cleaned(scene, poses, settings)
    changed = "".join(f", {stage}.{k}={v}" for stage, own in settings.items() for k, v in own.items())
    return Outcome(
        np.isin(classes, STANDING), ms, f"rays, clean and relabel on {PROCESSES} processes{changed}"
    )


def _version_of_peer() -> str:
    return metadata.version("dufomap") if util.find_spec("dufomap") else ""


def _version_of_ours() -> str:
    """Changes with any code of the stages."""
    digest = hashlib.sha256()
    for module in sorted(Path(stages.__path__[0]).rglob("*.py")):
        digest.update(module.read_bytes())
    return digest.hexdigest()[:16]


SYSTEMS = {
    system.name: system
    for system in (
        System("none", ("all",), _everything, lambda: "1"),
        System("denoise", ("labels",), _denoised, lambda: "1", ours=True),
        System(OURS, ("labels",), _ours, _version_of_ours, ours=True),
        System(PEER, ("d_p_1", "d_p_2"), _dufomap, _version_of_peer),
    )
}
