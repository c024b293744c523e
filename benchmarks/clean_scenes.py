"""The scenes that maps are cleaned on: made through the workflow, gathered into flat arrays, kept on disk.

A scene holds every point that counts: those that denoise calls own vehicle or out of range are left out, the same for all
systems. Where there is truth of poses there are two sets of them: true ones, and those of fusion.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clean_gathering import ESTIMATED, TRUE, gather
from benchmarks.sequences import NODE_OF, Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.product import Product
from scanloom.schemas.scans import (
    Deskewed,
    Labels,
)
from scanloom.schemas.session import Session, TruthLog
from scanloom.schemas.trajectory import Odometry, Truth
from scanloom.stages.geometry.se3 import F8

CLEANING = ("rays", "clean", "relabel")
"""Our stages that are run here; what they read apart from each other's products is made by the workflow."""
REAL = Path("../shared/data/kitti_raw_0005")


@dataclass(frozen=True)
class Place:
    """What a scene is made of."""

    drive: Drive
    poses: tuple[str, ...] = (TRUE, ESTIMATED)


_BUSY: dict[str, Any] = {"duration_s": 60.0, "busy": True}
_QUIET: dict[str, Any] = {"traffic": False, "dust_per_m": 0.0}
_SNOW: dict[str, Any] = {"start_m": 20.0, "duration_s": 20.0, "snow_per_m": 0.0035}
_DUST: dict[str, Any] = {"start_m": 620.0, "duration_s": 20.0, "dust_clouds": 0.8}


def places(seed: int = 0) -> dict[str, Place]:
    """All scenes; with another seed than 0 in another town, with other traffic and other noise."""
    seeds = {"seed": seed, "town_seed": seed, "parking_seed": seed} if seed else {}
    end = f"_{seed}" if seed else ""

    def town(name: str, title: str, more: Mapping[str, Any]) -> Place:
        return Place(Drive(name + end, title, {"beams": 32, **more, **seeds}))

    return {
        "town_32": town("town_32", "busy town, 32 beams", _BUSY),
        "town_64": town("town_64", "busy town, 64 beams", {**_BUSY, "duration_s": 40.0, "beams": 64}),
        "quiet": town("quiet", "town without traffic", {"duration_s": 40.0, **_QUIET}),
        "snow": town("snow", "snowfall in town", _SNOW),
        "dust": town("dust", "clouds of dust", _DUST),
        "kitti_0005": Place(Drive("kitti_0005", "KITTI 0005", folder=REAL), (ESTIMATED,)),
    }


@dataclass(frozen=True)
class Scene:
    """Points of all scans one after the other, and what they are; arrays are read from disk as needed."""

    name: str
    title: str
    folder: Path
    points: NDArray[np.float32]
    """(n, 3) m, in the LiDAR's frame of the point's scan."""
    labels: NDArray[np.uint8]
    """(n,) class of denoise."""
    true_class: NDArray[np.uint8]
    instance: NDArray[np.uint16]
    """(n,) number of the object, 0 for none."""
    starts: NDArray[np.int64]
    """(m + 1,) first point of each scan."""
    stamp_ns: NDArray[np.int64]
    poses: Mapping[str, F8]
    """(m, 4, 4) poses of the LiDAR by name of the set; each starts near its origin."""
    kinds: Mapping[str, Sequence[int]]
    """Numbers of the objects of each kind; one may be of several."""
    files: Mapping[str, Sequence[str]]
    """Where the products lie, by name."""
    inputs: Mapping[str, str]
    """Digest of points and poses by set of poses."""

    def __len__(self) -> int:
        """Number of scans."""
        return len(self.starts) - 1

    def scan(self, index: int) -> slice:
        """Rows of a scan."""
        return slice(int(self.starts[index]), int(self.starts[index + 1]))

    def first(self, chunks: int) -> Scene:
        """The scene as far as so many chunks reach."""
        scans = sum(len(Labels.open(Path(path))) for path in self.files[Labels.NAME][:chunks])
        end = int(self.starts[scans])
        columns = {name: getattr(self, name)[:end] for name in ("points", "labels", "true_class", "instance")}
        split = {product.NAME for product in (Deskewed, Labels)}
        return dataclasses.replace(
            self,
            **columns,
            starts=self.starts[: scans + 1],
            stamp_ns=self.stamp_ns[:scans],
            poses={name: T[:scans] for name, T in self.poses.items()},
            files={name: paths[:chunks] if name in split else paths for name, paths in self.files.items()},
            inputs={name: f"{digest}-{scans}" for name, digest in self.inputs.items()},
        )

    def placed(self, poses: str) -> NDArray[np.float32]:
        """All points (n, 3) in the map of these poses, m."""
        out = np.empty(self.points.shape, np.float32)
        for k, T in enumerate(self.poses[poses]):
            rows = self.scan(k)
            out[rows] = self.points[rows].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return out


def of_session() -> tuple[type[Product], ...]:
    """What the stages of cleaning read of a whole session."""
    read = dict.fromkeys(product for stage in CLEANING for product in NODE_OF[stage].reads)
    between = {product for stage in CLEANING for product in NODE_OF[stage].writes}
    return tuple(p for p in read if p not in between and p not in (Deskewed, Labels))


def made() -> tuple[type[Product], ...]:
    """What the workflow makes for a scene."""
    return tuple(dict.fromkeys((Truth, Deskewed, Labels, Session, Odometry, *of_session())))


def scene(place: Place, store: Path, kept: Path) -> Scene:
    """Run what is missing of the workflow and gather the points, unless that was done before.

    Raises
    ------
    ScanloomError : a stage failed.
    """
    result = produced(place.drive, made(), store)
    folder = kept / f"{place.drive.name}-{_digest(result)}"
    if not (folder / "scene.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        gather(place.drive.folder, result, folder)
    return _opened(place, folder, result)


def _digest(result: Result) -> str:
    read = (*made(), TruthLog)
    digests = sorted(
        part.digest for _, artifact in result.artifacts for product in read for part in artifact.of(product)
    )
    return hashlib.sha256("".join(digests).encode()).hexdigest()[:16]


def _opened(place: Place, folder: Path, result: Result) -> Scene:
    """The arrays, which the same products make again, with the places in the store where these lie now."""
    described = json.loads((folder / "scene.json").read_text())

    def array(name: str) -> NDArray[Any]:
        return np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r"))

    return Scene(
        name=place.drive.name,
        title=place.drive.title,
        folder=folder,
        points=array("points"),
        labels=array("labels"),
        true_class=array("true_class"),
        instance=array("instance"),
        starts=array("starts"),
        stamp_ns=array("stamp_ns"),
        poses={name: array(f"T_{name}") for name in place.poses},
        kinds=described["kinds"],
        files={p.NAME: [str(path) for _, path in result.files(p)] for p in (*made(), TruthLog)},
        inputs=described["inputs"],
    )
