"""Our own cleaning on two processes: what the engine does with `rays`, `clean` and `relabel`, and no more than that.

Scans lie in memory before the clock starts; what a stage hands to the next goes through files, as in the engine.
"""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_gathering import LEFT_OUT
from benchmarks.clean_scenes import Scene, of_session
from benchmarks.sequences import NODE_OF
from scanloom.schemas.clean import Cleared, FinalLabels, Rays
from scanloom.schemas.product import Coordinate, Part, Parts, Product
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Poses
from scanloom.stages.geometry import halves

PROCESSES = 2
SESSION: Coordinate = (("session", "bench"),)
WARM_UP = 4
"""Scans of a first run that loads compiled code."""

T = TypeVar("T")
Settings = Mapping[str, Mapping[str, Any]]
Files = list[tuple[Coordinate, Path]]


@dataclass(frozen=True)
class Job:
    """What all processes know; it is there before they are."""

    deskewed: list[Deskewed]
    labels: list[Labels]
    session: Mapping[type[Product], Product]
    """Products of the whole session, poses among them."""
    settings: Settings
    folder: Path

    def call(self, stage: str, given: Mapping[type[Product], Any]) -> Iterator[Any]:
        """Run a stage with its settings and its products in order; what it yields."""
        node = NODE_OF[stage]
        chosen = node.settings(**self.settings.get(stage, {}))
        known = {**self.session, **given}
        returned = node.stage(chosen, *(known[product] for product in node.reads))
        return iter((returned,) if isinstance(returned, Product | Part) else returned)

    def of_chunk(self, number: int) -> dict[type[Product], Any]:
        """Scans and labels of one chunk."""
        return {Deskewed: self.deskewed[number], Labels: self.labels[number]}

    def rays(self, number: int) -> Files:
        """Free space by one chunk; its parts, written."""
        where = (*SESSION, ("chunk", f"{number:04d}"))
        return self._written(self.call("rays", self.of_chunk(number)), where, "tile")

    def cleared(self, tile: str, rays: Files) -> Files:
        """Verdicts on one tile, written."""
        parts = self.call("clean", {Rays: Parts(rays, load=Rays.open)})
        return [
            (_standing(SESSION, tile), path) for _, path in self._written(parts, (("tile", tile),), "session")
        ]

    def classes(self, number: int, cleared: Files) -> list[NDArray[np.uint8]]:
        """Final classes of the points of one chunk that count, scan by scan."""
        given = {**self.of_chunk(number), Cleared: Parts(cleared, load=Cleared.open)}
        for made in self.call("relabel", given):
            if isinstance(made, FinalLabels):
                pairs = zip(made, self.labels[number], strict=True)
                return [final.class_[~np.isin(label.class_, LEFT_OUT)] for final, label in pairs]
        raise ValueError("relabel made no final labels")

    def _written(self, parts: Iterable[Any], where: Coordinate, axis: str) -> Files:
        """Write the parts of a table; each stands at `where` and at its own key along `axis`."""
        files: Files = []
        for part in parts:
            name = "-".join(value for _, value in (*where, ("", part.key)))
            path = self.folder / f"{part.product.NAME}-{name}.parquet"
            part.product.write(path)
            files.append(((*where, (axis, part.key)), path))
        return files


def _standing(where: Coordinate, tile: str) -> Coordinate:
    return (*where, ("tile", tile))


def job(scene: Scene, poses: str, settings: Settings, folder: Path) -> Job:
    """Everything read; the poses are those of the named set."""
    deskewed = [Deskewed([*Deskewed.open(Path(path))]) for path in scene.files[Deskewed.NAME]]
    labels = [Labels([*Labels.open(Path(path))]) for path in scene.files[Labels.NAME]]
    session = {p: p.open(Path(scene.files[p.NAME][0])) for p in of_session()}
    estimated = session[Poses]
    assert isinstance(estimated, Poses)
    placed = dataclasses.replace(
        estimated.take(slice(0, len(scene))), T_world_lidar=np.array(scene.poses[poses])
    )
    return Job(deskewed, labels, {**session, Poses: placed}, settings, folder)


def final_classes(work: Job) -> tuple[NDArray[np.uint8], float]:
    """Final class (n,) of every point of the scene, and the wall time of all stages together, s."""
    _load_kernels(work)
    global _work
    _work = work
    with processes(PROCESSES) as pool:
        started = time.perf_counter()
        numbers = range(len(work.deskewed))
        rays = sorted(itertools.chain.from_iterable(pool.imap_unordered(_rays, numbers)))
        tiles = itertools.groupby(sorted(rays, key=_tile), key=_tile)
        named = [(tile, list(files)) for tile, files in tiles]
        cleared = sorted(itertools.chain.from_iterable(pool.imap_unordered(_cleared, named)))
        classes = pool.map(_classes, [(number, cleared) for number in numbers], chunksize=1)
        seconds = time.perf_counter() - started
    return np.concatenate([*itertools.chain.from_iterable(classes)]), seconds


@contextmanager
def processes(count: int) -> Iterator[Pool]:
    """Copies of this process, which end of themselves."""
    pool = multiprocessing.get_context("fork").Pool(count, initializer=_wake_helper)
    try:
        yield pool
    finally:
        pool.close()
        pool.join()


def apart(errand: Callable[[], T]) -> T:
    """Do something in a copy of this process, which its threads and its handling of signals do not outlive."""
    global _errand
    _errand = errand
    with processes(1) as pool:
        done: T = pool.apply(_run_errand)
    return done


def _run_errand() -> Any:
    assert _errand is not None
    return _errand()


def _wake_helper() -> None:
    """Threads do not come along into a copy of a process."""
    halves._helper = ThreadPoolExecutor(1)


_errand: Callable[[], Any] | None = None
_work: Job | None = None
"""Of the processes: they are copies of the one that set it."""


def _mine() -> Job:
    assert _work is not None
    return _work


def _rays(number: int) -> Files:
    return _mine().rays(number)


def _cleared(tile: tuple[str, Files]) -> Files:
    return _mine().cleared(*tile)


def _classes(chunk: tuple[int, Files]) -> list[NDArray[np.uint8]]:
    return _mine().classes(*chunk)


def _tile(file: tuple[Coordinate, Path]) -> str:
    return dict(file[0])["tile"]


def _load_kernels(work: Job) -> None:
    """The stages once, on the first scans."""
    with tempfile.TemporaryDirectory(prefix="clean-") as folder:
        small = dataclasses.replace(
            work, deskewed=[_few(work.deskewed[0])], labels=[_few(work.labels[0])], folder=Path(folder)
        )
        rays = sorted(small.rays(0), key=_tile)
        cleared = [
            file
            for tile, files in itertools.groupby(rays, key=_tile)
            for file in small.cleared(tile, list(files))
        ]
        small.classes(0, sorted(cleared))


def cleaned(scene: Scene, poses: str, settings: Settings) -> tuple[NDArray[np.uint8], float]:
    """Final class (n,) of every point of the scene and ms per scan."""
    with tempfile.TemporaryDirectory(prefix="clean-") as folder:
        classes, seconds = final_classes(job(scene, poses, settings, Path(folder)))
    return classes, 1e3 * seconds / len(scene)


def tracking_ms(scene: Scene) -> float:
    """ms per scan of the tracker, whose boxes `relabel` reads: one process, scans in memory."""
    where = [(*SESSION, ("chunk", f"{k:04d}")) for k in range(len(scene.files[Labels.NAME]))]
    deskewed = [Deskewed([*Deskewed.open(Path(path))]) for path in scene.files[Deskewed.NAME]]
    labels = [Labels([*Labels.open(Path(path))]) for path in scene.files[Labels.NAME]]
    given = {
        Deskewed: Parts(zip(where, deskewed)), Labels: Parts(zip(where, labels)),
        **{p: p.open(Path(scene.files[p.NAME][0])) for p in NODE_OF["objects"].reads if p not in (Deskewed, Labels)},
    }  # fmt: skip
    node = NODE_OF["objects"]
    few = {
        **given,
        Deskewed: Parts([(where[0], _few(deskewed[0]))]),
        Labels: Parts([(where[0], _few(labels[0]))]),
    }
    node.stage(node.settings(), *(few[product] for product in node.reads))
    started = time.perf_counter()
    node.stage(node.settings(), *(given[product] for product in node.reads))
    return 1e3 * (time.perf_counter() - started) / len(scene)


def _few(stream: Any) -> Any:
    return type(stream)([stream[k] for k in range(min(WARM_UP, len(stream)))])
