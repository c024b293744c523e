"""Two maps side by side: metrics, trajectories, points, settings, sizes; and whether the second is worse than noise allows."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from scanloom.schemas.errors import EXIT_OK, EXIT_REGRESSION, InvalidInput, ScanloomError
from scanloom.schemas.trajectory import Poses
from scanloom.stages.evaluation.difference import (
    FARTHEST_M,
    ONLY_M,
    Ground,
    PathDifference,
    mean_motion,
    nearest_distances,
    path_difference,
    same_scans,
)
from scanloom.stages.exports.source import MapSource
from scanloom.stages.geometry.geodesy import between_worlds
from scanloom.stages.geometry.se3 import F8, inverse
from scanloom.stages.report.comparison import comparison_page
from scanloom.workflows.delivery import MAP_FILE, MAP_FORMAT, read_map
from scanloom.workflows.metric_changes import Change, Row, metric_changes, regressions
from scanloom.workflows.noise import Noise, measured, read_noise
from scanloom.workflows.sessions import SIMULATED_SESSIONS
from scanloom.workflows.sources import SourceOfSession, Sources, read_sources

SAMPLES = 20_000
"""Points of each map whose nearest in the other is sought."""
TILES_KEPT = 12
MAP_AGAIN = "give two folders that `scanloom map` or `scanloom extend` filled"


@dataclass(frozen=True)
class Side:
    """One of the two maps, as far as it can be read."""

    folder: Path
    header: Mapping[str, Any]
    """Content of `map.json`."""
    metrics: list[Row]
    sources: Sources | None

    @property
    def logs(self) -> dict[str, str]:
        """Digest of the log of each session by its name."""
        return {str(row["name"]): str(row.get("log", "")) for row in self.header["sessions"]}

    @property
    def sessions(self) -> dict[str, str]:
        """What tells the logs of the sessions apart, by name: digests, and of simulated ones all that is simulated but the seed
        of chance, so that runs with other noise are runs of the same log."""
        rows = () if self.sources is None else self.sources.sessions
        return self.logs | {row.name: _drive(row) for row in rows if row.word in SIMULATED_SESSIONS}


def _drive(session: SourceOfSession) -> str:
    told = {name: value for name, value in session.settings.get("simulate", {}).items() if name != "seed"}
    return f"{session.word} {json.dumps(told, sort_keys=True)}"


@dataclass(frozen=True)
class Setting:
    """Something that was different when the maps were made."""

    name: str
    a: str
    b: str


@dataclass(frozen=True)
class OneWay:
    """Points of one map against the nearest ones of the other."""

    samples: int
    median_m: float
    p95_m: float
    only_share: float
    """Share of points without another one within half a metre."""


@dataclass(frozen=True)
class Comparison:
    """All that is different between map A and map B."""

    a: Side
    b: Side
    metrics: list[Change]
    paths: dict[str, PathDifference]
    a_to_b: OneWay | None
    b_to_a: OneWay | None
    settings: list[Setting]
    sizes: list[Setting]
    notes: list[str]
    """What could not be compared, or with what reservation."""

    @property
    def regressions(self) -> list[Change]:
        return regressions(self.metrics)

    @property
    def exit_code(self) -> int:
        return EXIT_REGRESSION if self.regressions else EXIT_OK

    def as_json(self) -> dict[str, Any]:
        points = {"a_to_b": self.a_to_b, "b_to_a": self.b_to_a}
        return {
            "a": str(self.a.folder),
            "b": str(self.b.folder),
            "exit_code": self.exit_code,
            "regressions": [change.label for change in self.regressions],
            "notes": self.notes,
            "metrics": [change.as_json() for change in self.metrics],
            "trajectories": {name: vars(path) for name, path in self.paths.items()},
            "points": {name: None if way is None else vars(way) for name, way in points.items()},
            "settings": [vars(row) for row in self.settings],
            "sizes": [vars(row) for row in self.sizes],
        }

    def page(self) -> str:
        """As one self-contained page."""
        return comparison_page(self.as_json(), f"{self.b.header['name']} against {self.a.header['name']}")


def compare_maps(folder_a: Path, folder_b: Path, noise_from: Sequence[Path] = ()) -> Comparison:
    """Hold map B against map A. `noise_from` is a file of noise, or three maps or more of the same log.

    Raises
    ------
    InvalidInput : one of them is no map, or of another format.
    UsageError : too few maps to measure noise.
    """
    a, b = read_side(folder_a), read_side(folder_b)
    noise = noise_of(noise_from) if noise_from else None
    judged, notes = judged_sessions(a, b)
    if noise is None and judged:
        notes.append(
            "No noise was measured: what is allowed is the default of each metric (docs/metrics.md)."
        )
    geometry = _geometry(a, b, notes)
    return Comparison(
        a, b, metric_changes(a.metrics, b.metrics, noise, judged), *geometry, settings_that_differ(a, b), sizes(a, b), notes
    )  # fmt: skip


def read_side(folder: Path) -> Side:
    """
    Raises
    ------
    InvalidInput : the folder holds no map, or one of another format or without metrics.
    """
    header = read_map(folder)
    if not header:
        raise InvalidInput(
            f"holds no map: {MAP_FILE} is missing or damaged", where=str(folder), next_step=MAP_AGAIN
        )
    if header.get("format") != MAP_FORMAT or not isinstance(header.get("sessions"), list):
        raise InvalidInput(
            f"the map is of format {header.get('format')!r}; this program compares maps of format {MAP_FORMAT!r}",
            where=str(folder),
            next_step="compare with the version of the program that made it, or make the map again",
        )
    try:
        sources = read_sources(folder)
    except InvalidInput:
        sources = None
    return Side(folder, header, _metrics(folder), sources)


def noise_of(given: Sequence[Path]) -> Noise:
    """From a file, or measured from maps."""
    if len(given) == 1 and given[0].is_file():
        return read_noise(given[0])
    return measured([(str(folder), read_side(folder).metrics) for folder in given])


def _metrics(folder: Path) -> list[Row]:
    path = folder / "metrics.json"
    try:
        rows: list[Row] = json.loads(path.read_text())
        if all({"name", "value"} <= set(row) for row in rows):
            return rows
    except (OSError, ValueError, TypeError):
        pass
    raise InvalidInput("is missing or damaged", where=str(path), next_step="make the map again")


def judged_sessions(a: Side, b: Side) -> tuple[frozenset[str], list[str]]:
    """Sessions whose metrics may be judged, "" for the whole map, "*" for a session without a name; and what to say of it."""
    shared = [name for name, log in a.sessions.items() if b.sessions.get(name) == log]
    by_log = {log for log in a.sessions.values() if log} & {log for log in b.sessions.values() if log}
    same = len(a.sessions) == len(b.sessions) and (
        set(shared) == set(a.sessions) or by_log == set(a.sessions.values()) == set(b.sessions.values())
    )
    if same:
        return frozenset({"", "*", *shared}), []
    if shared:
        only = ", ".join(sorted(set(a.sessions) ^ set(b.sessions))) or "sessions whose logs differ"
        return frozenset(shared), [
            f"The maps hold different sessions ({only}): figures of the whole map are shown and not judged."
        ]
    return frozenset(), [
        "The maps were made of different logs: everything is shown side by side, and nothing is judged."
    ]


# ---------------------------------------------------------------------------------------------------------------------


def _geometry(
    a: Side, b: Side, notes: list[str]
) -> tuple[dict[str, PathDifference], OneWay | None, OneWay | None]:
    """Trajectories and points, as far as both maps can be read."""
    try:
        map_a, map_b = MapSource.open(a.folder), MapSource.open(b.folder)
        pairs = _paired(a, b, map_a.trajectories(), map_b.trajectories())
    except (ScanloomError, OSError) as error:
        notes.append(f"Trajectories and points are not compared: {error}")
        return {}, None, None
    T_a_b = _between_frames(map_a, map_b)
    paths = {name: path_difference(*pair, T_a_b) for name, pair in pairs.items()}
    if not paths and T_a_b is None:
        notes.append("The maps have no scan in common and no place on the Earth: points are not compared.")
        return {}, None, None
    if not paths:
        notes.append("The maps have no scan in common: points are compared as they lie on the Earth.")
    both = [np.concatenate(each) for each in zip(*pairs.values())]
    T: F8 = mean_motion(both[0], both[1]) if both else np.asarray(T_a_b)
    try:
        forth, back = _one_way(map_a, map_b, inverse(T)), _one_way(map_b, map_a, T)
    except (ScanloomError, OSError) as error:
        notes.append(f"Points are not compared: {error}")
        return paths, None, None
    return paths, forth, back


def _paired(a: Side, b: Side, of_a: dict[str, Poses], of_b: dict[str, Poses]) -> dict[str, tuple[F8, F8]]:
    """Poses of the same scans by session: of the same name, else of the same log."""
    by_log = {log: name for name, log in b.sessions.items() if log}
    pairs = {}
    for name, poses in of_a.items():
        other = of_b.get(name) or of_b.get(by_log.get(a.sessions.get(name, ""), ""))
        if other is not None:
            both = same_scans(poses, other)
            if len(both[0]):
                pairs[name] = both
    return pairs


def _between_frames(a: MapSource, b: MapSource) -> F8 | None:
    """T_a_b as the maps themselves say; maps without a place on the Earth start at the first scan of the same log."""
    place_a, place_b = a.georeference, b.georeference
    if place_a is not None and place_b is not None:
        return between_worlds(place_a, place_b)
    return np.eye(4) if place_a is None and place_b is None else None


def _one_way(of: MapSource, to: MapSource, T_to_of: F8) -> OneWay | None:
    distance = nearest_distances(_ground(of), _ground(to), T_to_of, SAMPLES)
    if not len(distance):
        return None
    capped = np.minimum(distance, FARTHEST_M)
    return OneWay(
        len(distance), float(np.median(capped)), float(np.quantile(capped, 0.95)), float((distance > ONLY_M).mean())
    )  # fmt: skip


def _ground(source: MapSource) -> Ground:
    rows = list(source.index.by_tile().items())
    low = [source.index.min_m[at].min(axis=0) for _, at in rows]
    high = [source.index.max_m[at].max(axis=0) for _, at in rows]
    points = [int(source.index.points[at].sum()) for _, at in rows]
    read = lru_cache(TILES_KEPT)(lambda i: source.tile(rows[i][0]))
    return Ground(
        np.array(low).reshape(-1, 3), np.array(high).reshape(-1, 3), np.array(points, np.int64), read
    )


# ---------------------------------------------------------------------------------------------------------------------


def settings_that_differ(a: Side, b: Side) -> list[Setting]:
    """Settings, versions and grids of which the maps were made."""
    one, other = dict(_circumstances(a)), dict(_circumstances(b))
    return [
        Setting(name, one.get(name, "default"), other.get(name, "default"))
        for name in {**one, **other}
        if one.get(name) != other.get(name)
    ]


def _circumstances(side: Side) -> Iterator[tuple[str, str]]:
    for name in ("voxel_size_m", "tile_size_m", "frame", "epsg", "version"):
        yield name, str(side.header.get(name))
    yield "sessions", ", ".join(sorted(side.sessions))
    for name, log in side.logs.items():
        yield f"log of {name}", log[:16] or "simulated"
    if side.sources is None:
        return
    yield "program", side.sources.program or "unknown"
    for stage, fields in side.sources.settings.items():
        for name, value in fields.items():
            yield f"{stage}.{name}", str(value)
    for session in side.sources.sessions:
        for stage, fields in session.settings.items():
            for name, value in fields.items():
                yield f"{stage}.{name} of {session.name}", str(value)


def sizes(a: Side, b: Side) -> list[Setting]:
    """Points, tiles and bytes of both."""
    return [
        Setting(name, f"{x:,}".replace(",", " "), f"{y:,}".replace(",", " "))
        for (name, x), (_, y) in zip(_sizes(a), _sizes(b))
    ]


def _sizes(side: Side) -> Iterator[tuple[str, int]]:
    files = side.header.get("files", {})
    tiles = {n: f for n, f in files.items() if n.startswith("tiles/") and n.endswith(".parquet")}
    yield "points", int(side.header.get("points", 0))
    yield "files", len(files)
    yield "bytes of all files", sum(int(f.get("bytes", 0)) for f in files.values())
    yield "bytes of tiles", sum(int(f.get("bytes", 0)) for f in tiles.values())
