"""The drives that systems are compared on: simulated here, or read from folders; made once, kept in a store.

Raw scans, deskewed scans, labels, sensors and truth come from the stages of the workflow, through the engine: what was
made with the same settings and code is taken from the store.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from scanloom.pipeline.request import Request, SessionInput
from scanloom.pipeline.run import Result, run
from scanloom.pipeline.store import Store
from scanloom.schemas.base import BaseLog
from scanloom.schemas.product import Files, Parts, Product
from scanloom.schemas.scans import Deskewed, Scans
from scanloom.schemas.session import RawLog, TruthLog
from scanloom.schemas.trajectory import Truth
from scanloom.schemas.windows import Track, TrackEnds
from scanloom.stages.logs.locate import locate
from scanloom.workflows.map_session import NODES, SIMULATED

NODE_OF = {node.name: node for node in NODES}
WRITER_OF = {product: node for node in NODES for product in node.writes}
MEASURED = ("deskew", "odometry")
"""Stages that are run here, on what the engine made."""
OF_WINDOWS = (Track, TrackEnds)
"""What odometry joins when a session is cut; here it never is."""


def _made() -> tuple[type[Product], ...]:
    """What the measured stages and the comparison read."""
    read = [product for name in MEASURED for product in NODE_OF[name].reads]
    return tuple(p for p in dict.fromkeys([*read, Truth]) if p not in OF_WINDOWS)


def _makers(wanted: Sequence[type[Product]]) -> set[str]:
    """Names of the nodes that it takes to make the products, from the log on."""
    found: set[str] = set()
    waiting = [*wanted]
    while waiting:
        node = WRITER_OF.get(waiting.pop())
        if node is not None and node.name not in found:
            found.add(node.name)
            waiting += node.reads
    return found


PRODUCTS = _made()

ProductT = TypeVar("ProductT", bound=Product)
Settings = Mapping[str, Any]


@dataclass(frozen=True)
class Drive:
    """What to make: settings of the simulator, or a folder with a log."""

    name: str
    title: str
    simulate: Settings | None = None
    folder: Path | None = None


TUNNEL_M = 600.0
"""Long enough for the directive after which it is furnished (500 m). The one of 72 m in the sample's town shows the street
to a quarter of the scans in it."""
_TOWN = {"start_m": 150.0, "duration_s": 36.0}

SIMULATED_DRIVES = (
    Drive("town_32", "town, 32 beams", {**_TOWN, "beams": 32}),
    Drive("town_16", "town, 16 beams", {**_TOWN, "beams": 16}),
    Drive("town_64", "town, 64 beams", {**_TOWN, "beams": 64}),
    Drive(
        "tunnel",
        f"street, tunnel of {TUNNEL_M:g} m, field; 32 beams",
        {"start_m": 440.0, "duration_s": 67.0, "tunnel_m": TUNNEL_M},
    ),
    Drive("field", "open field, 32 beams", {"start_m": 610.0, "duration_s": 26.0}),
)
KITTI = "kitti_raw_0005"


@dataclass(frozen=True)
class Recording:
    """Where the products of one drive lie."""

    name: str
    title: str
    simulated: bool
    files: Mapping[str, Sequence[str]]
    digest: str
    """Of raw scans and truth: what systems say that read nothing else is kept under it."""
    deskewed_digest: str
    """The same with the deskewed scans."""
    made_digest: str
    """Of everything that our stages read."""

    def __len__(self) -> int:
        """Number of scans."""
        return sum(len(part.index) for part in self.parts(Scans))

    def parts(self, product: type[ProductT]) -> Parts[ProductT]:
        """All chunks of a product, opened when asked for."""
        coordinates = (
            (("session", self.name), ("chunk", f"{k:04d}")) for k in range(len(self.files[product.NAME]))
        )
        paths = (Path(path) for path in self.files[product.NAME])
        return Parts(list(zip(coordinates, paths)), load=product.open)

    def one(self, product: type[ProductT]) -> ProductT:
        """A product that is not split."""
        (path,) = self.files[product.NAME]
        return product.open(Path(path))

    def arguments(self, stage: str, given: Mapping[type[Product], Any]) -> list[Any]:
        """What a stage is called with after its settings: its products in order, those `given` in place of the files."""
        return [given[p] if p in given else self.one(p) for p in NODE_OF[stage].reads if p in PRODUCTS]


def drives(folders: Sequence[Path], names: Sequence[str] = ()) -> list[Drive]:
    """The simulated drives and the folders, those called `names` if any are named."""
    found = [*SIMULATED_DRIVES]
    for folder in folders:
        name = re.sub(r"[^A-Za-z0-9_]+", "_", folder.resolve().name).strip("_")
        found.append(Drive(name, str(folder.name), folder=folder))
    unknown = set(names) - {drive.name for drive in found}
    if unknown:
        known = ", ".join(drive.name for drive in found)
        raise SystemExit(f"no sequence {', '.join(sorted(unknown))}; there are {known}")
    return [drive for drive in found if not names or drive.name in names]


def make(chosen: Sequence[Drive], store: Path, *, cluster: str = "local") -> list[Recording]:
    """Run what is missing of simulation, ingest, deskew and denoise; the recordings, in the order of the drives."""
    makers = _makers(PRODUCTS)
    nodes = tuple(n for n in NODES if n.name in makers)
    request = Request(nodes=nodes, sessions=tuple(_session(drive) for drive in chosen))
    result = run(request, Store(store), cluster=cluster if len(chosen) > 1 else "none")
    for task in result.failures:
        if task.error is not None:
            raise task.error
    return [_sequence(drive, result) for drive in chosen]


def produced(drive: Drive, wanted: Sequence[type[Product]], store: Path) -> Result:
    """Run what is missing of the workflow up to the products, as a map of this drive alone."""
    makers = _makers(wanted)
    nodes = tuple(n for n in NODES if n.name in makers)
    result = run(Request(nodes=nodes, sessions=(_session(drive),)), Store(store), cluster="none")
    for task in result.failures:
        if task.error is not None:
            raise task.error
    return result


def _session(drive: Drive) -> SessionInput:
    if drive.folder is None:
        return SessionInput(
            drive.name, {BaseLog: BaseLog()}, {"simulate": dict(drive.simulate or {})}, frozenset({SIMULATED})
        )
    log = locate(drive.folder)
    sources: dict[type[Product], Files] = {RawLog: log.raw_log, TruthLog: log.truth_log, BaseLog: BaseLog()}
    return SessionInput(drive.name, sources, log.settings)


def _sequence(drive: Drive, result: Result) -> Recording:
    files = {
        product.NAME: [
            str(path) for where, path in result.files(product) if dict(where)["session"] == drive.name
        ]
        for product in PRODUCTS
    }
    digests = (
        _digest(drive, result, *products) for products in ((Scans, Truth), (Scans, Truth, Deskewed), PRODUCTS)
    )
    return Recording(drive.name, drive.title, drive.folder is None, files, *digests)


def _digest(drive: Drive, result: Result, *products: type[Product]) -> str:
    found = sorted(
        part.digest
        for where, artifact in result.artifacts
        if dict(where).get("session") == drive.name
        for product in products
        for part in artifact.of(product)
    )
    return hashlib.sha256("".join(found).encode()).hexdigest()[:16]
