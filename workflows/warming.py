"""Compile ahead of the first map: the modules to bytecode, and the kernels by mapping a few simulated seconds."""

from __future__ import annotations

import compileall
import tempfile
from importlib import import_module
from itertools import islice
from pathlib import Path

import numpy as np

from scanloom.pipeline.run import Result
from scanloom.schemas.errors import StageError
from scanloom.schemas.scans import Scans
from scanloom.stages.geometry.kernels import cache_folder, remember_signatures
from scanloom.stages.loops.candidates import Candidate
from scanloom.stages.loops.submaps import Submap
from scanloom.stages.loops.verification import Drift, VerificationSettings, verify
from scanloom.workflows.build_map import Order, build_map
from scanloom.workflows.sessions import SAMPLE

MARKER = "warm"
PACKAGES = ("schemas", "stages", "pipeline", "workflows")
BARE_SCANS = 12
CHUNK_S = 2.0
"""Several chunks, so that what merges them is compiled, too."""
CAMERA = {"cameras": 1, "camera_width_px": 160, "camera_height_px": 100, "camera_rate_hz": 2.0}
"""A few small images, for what only images ask for."""


def is_warm() -> bool:
    """Whether this version of the code was compiled on this machine."""
    return (cache_folder() / MARKER).exists()


def compile_modules() -> None:
    """Bytecode of every module, also where Python is told not to write it (containers often are): else each process of
    each run would compile them all. Where the package is read-only nothing happens."""
    for name in PACKAGES:
        for folder in import_module(f"scanloom.{name}").__path__:
            compileall.compile_dir(folder, quiet=2)


def warm_kernels() -> None:
    """Map the small sample, and a few of its scans as a log of nothing but points; the compiled kernels stay."""
    with tempfile.TemporaryDirectory(prefix="scanloom-warm-") as scratch:
        folder = Path(scratch)
        sample = _map(SAMPLE, folder)
        _map(str(_bare_points(sample, folder / "bare")), folder)
    _match()
    remember_signatures()
    (cache_folder() / MARKER).touch()


def _match() -> None:
    """Match a submap with itself: a drive of seconds meets no place twice."""
    rng = np.random.default_rng(0)
    along, height = rng.uniform(-20, 20, 6000), rng.uniform(-1.8, 6.0, 6000)
    walls = np.column_stack((along, np.where(along > 3, 9.0, -7.0) + np.sin(along), height))
    ground = np.column_stack((rng.uniform(-20, 20, (6000, 2)), np.full(6000, -1.8)))
    points = np.concatenate((walls, ground, walls[:, [1, 0, 2]] + np.array([8.0, 0.0, 0.0])))
    submap = Submap(points, points[:, 2] < -1.79, np.eye(4), -1.8, points)
    candidate = Candidate(0, 0, 0, 1, float("nan"), float("nan"), np.eye(4), 0.0)
    verify(VerificationSettings(), candidate, Drift(100.0), submap, submap)


def _map(session: str, folder: Path) -> Result:
    order = Order(
        sessions=(session,),
        out=folder / "maps" / Path(session).name,
        name=Path(session).name,
        store=folder / "store",
        cluster="none",
        command_line={"simulate": {"size": "small"} | CAMERA, "ingest": {"chunk_s": CHUNK_S}},
    )
    outcome = build_map(order)
    for _, error in outcome.failures:
        raise error
    if outcome.result is None:
        raise StageError(f"{session} was not mapped", next_step="run `scanloom map sample` to see why")
    return outcome.result


def _bare_points(sample: Result, folder: Path) -> Path:
    """Scans as KITTI stores them: points without times and beams, no other sensor. What that asks for is compiled, too."""
    data = folder / "velodyne_points" / "data"
    data.mkdir(parents=True)
    for n, scan in enumerate(islice(iter(sample.parts(Scans)[0]), BARE_SCANS)):
        points = np.column_stack((scan.x_m, scan.y_m, scan.z_m, scan.intensity))
        points.astype("<f4").tofile(data / f"{n:010d}.bin")
    return folder
