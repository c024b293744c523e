"""The drives on which loops are looked for: simulated ones with revisits in both directions, and logs given.

Towns differ from street to street; estates are made to deceive, with parallel streets of the same houses and one that
repeats itself. All are made once and kept in the store of the benchmarks.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.sequences import Drive, produced
from scanloom.schemas.loops import Loops, Places
from scanloom.schemas.scans import Deskewed, Labels
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.geometry.interpolation import inside, interpolate_poses
from scanloom.stages.geometry.se3 import F8
from scanloom.stages.loops.candidates import Track, tracks_of
from scanloom.stages.loops.reading import ScanShelf, joined

SEEDS = (0, 1, 2)
DURATION_S = 180.0
"""About one lap: revisits in the same and in the opposite direction."""
KINDS = {"towns": "town", "estates": "estate"}
"""Groups of worlds and the simulator's name for their route."""


@dataclass(frozen=True)
class World:
    """One drive as the stages left it, and the truth of its keyframes."""

    name: str
    track: Track
    """All keyframes that truth covers, in one piece."""
    T_true: F8
    odometry: Odometry
    truth: Truth
    loops: Loops
    shelf: ScanShelf
    """Where the scans of the keyframes are."""


def simulated(kind: str, seeds: Sequence[int] = SEEDS) -> list[Drive]:
    """The drives of one kind, one per seed of world, sensors and parked cars."""
    route = KINDS[kind]
    return [
        Drive(
            f"{route}_{seed}",
            f"{route}, seed {seed}",
            {"route": route, "duration_s": DURATION_S, "town_seed": seed, "seed": seed, "parking_seed": seed},
        )
        for seed in seeds
    ]


def given(folder: Path) -> Drive:
    """A log in a folder."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", folder.resolve().name).strip("_")
    return Drive(name, folder.name, folder=folder)


def world(drive: Drive, store: Path) -> World:
    """Run what is missing of the workflow up to its loops.

    Raises
    ------
    ScanloomError : a stage failed.
    SystemExit : the log has no truth.
    """
    result = produced(drive, (Truth, Deskewed, Labels, Odometry, Places, Loops), store)
    truth, odometry, loops = result.parts(Truth)[0], result.parts(Odometry)[0], result.parts(Loops)[0]
    track, T_true = covered(drive.name, odometry, joined(list(result.parts(Places))), truth)
    if not len(track):
        raise SystemExit(f"{drive.name}: there is no truth to judge loops by")
    shelf = ScanShelf(result.parts(Deskewed), result.parts(Labels))
    return World(drive.name, track, T_true, odometry, truth, loops, shelf)


def covered(name: str, odometry: Odometry, places: Places, truth: Truth) -> tuple[Track, F8]:
    """Keyframes that truth covers as one track, whatever odometry lost, and their true poses (n, 4, 4)."""
    stamps = odometry.stamp_ns[np.searchsorted(odometry.scan_index, places.scan_index)]
    kept = inside(truth.stamp_ns, stamps)
    whole = dataclasses.replace(odometry, segment=np.zeros(len(odometry), np.int32))
    (track,) = tracks_of(name, whole, places.take(np.flatnonzero(kept)))
    if not kept.any():
        return track, np.empty((0, 4, 4))
    return track, interpolate_poses(truth.stamp_ns, truth.T_truth_lidar, stamps[kept])
