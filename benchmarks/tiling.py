"""Tiling: points a second, memory against the size of the map, and how fast maps leave for other formats.

`python -m benchmarks.tiling [--store FOLDER] [--seconds S] [--million N ...] [--maps FOLDER] [--formats NAME ...] [--json -]`
makes the sample world, tiles its scans on two cores, and repeats it side by side until the map has so many million points.
Maps are kept with `--maps`, to look at; `--formats` exports the smallest of them. What lies side by side is one and the same
street: every tile, every file and every level is there, only the places are not new.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import published
from benchmarks.scores import Figure
from benchmarks.sequences import Drive, produced
from scanloom.pipeline.run import Result
from scanloom.schemas.clean import FinalLabels
from scanloom.schemas.product import Coordinate, Parts
from scanloom.schemas.scans import Deskewed
from scanloom.schemas.tiles import Piece, RemovedTile, Tile, TileIndex
from scanloom.schemas.trajectory import Poses
from scanloom.stages.tiling import overview, tiles, tiling
from scanloom.stages.tiling.grid import tile_name, tile_position
from scanloom.stages.tiling.overview import Settings as OverviewSettings
from scanloom.stages.tiling.pieces import Settings as TilingSettings
from scanloom.stages.tiling.tiles import Settings as TilesSettings

CORES = 2
Paths = list[tuple[Coordinate, Path]]


def main() -> None:
    options = _options()
    result = produced(_drive(options.seconds), (Deskewed, FinalLabels, Poses), options.store)
    with tempfile.TemporaryDirectory(dir=options.maps or options.store) as scratch:
        pieces = Path(scratch) / "pieces"
        figures = list(throughput(result, pieces))
        for million in options.million:
            kept = (options.maps or Path(scratch)) / f"map_{million:g}m"
            figures += sized(pieces, million, kept)
            if options.formats and million == min(options.million):
                figures += exported(kept, options.formats, Path(scratch))
    published(figures, options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--store", type=Path, default=Path("build/tiling"), help="folder of what is made")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the drive")
    parser.add_argument("--million", type=float, nargs="*", default=[1, 10, 100], help="points of the maps")
    parser.add_argument("--maps", type=Path, help="folder in which the maps stay")
    parser.add_argument("--formats", nargs="*", default=[], help="formats to export the smallest map to")
    parser.add_argument("--json", default="", help="file, or - for standard output")
    options = parser.parse_args()
    options.store.mkdir(parents=True, exist_ok=True)
    if options.maps:
        options.maps.mkdir(parents=True, exist_ok=True)
    return options


def _drive(seconds: float) -> Drive:
    name = f"tiling_{seconds:g}"
    return Drive(name, name, {"duration_s": seconds})


def throughput(result: Result, folder: Path) -> Iterator[Figure]:
    """Points of scans a second from labelled scans to tiles on `CORES` processes, reading and writing included."""
    chunks = [
        (str(scans), str(labels), str(poses))
        for (_, scans), (_, labels) in zip(result.files(Deskewed), result.files(FinalLabels), strict=True)
        for _, poses in result.files(Poses)
    ]
    folder.mkdir()
    context = multiprocessing.get_context("spawn")
    with context.Pool(CORES) as pool:
        pool.starmap(_ready, [chunks[0]] * CORES, 1)
        started = time.monotonic()
        points = sum(pool.starmap(_pieces, [(i, *chunk, str(folder)) for i, chunk in enumerate(chunks)], 1))
        between = time.monotonic()
        names = sorted({path.stem for path in folder.rglob("*.parquet")})
        (folder.parent / "tiles").mkdir()
        kept = sum(pool.starmap(_tile, [(name, str(folder), str(folder.parent)) for name in names], 1))
        ended = time.monotonic()
    how = f"{points} points of {len(chunks)} chunks into {kept} of {len(names)} tiles, {CORES} processes, files included"
    yield Figure("bench.tiling.points_per_s", points / (ended - started), "1/s", "run", how)
    yield Figure(
        "bench.tiling.pieces_share", (between - started) / (ended - started), "", "run", "of that time"
    )


def _ready(scans: str, labels: str, poses: str) -> None:
    """Loads libraries and kernels; long enough for each process to get a turn."""
    some = Deskewed([Deskewed.open(Path(scans))[0]]), FinalLabels([FinalLabels.open(Path(labels))[0]])
    pieces = list(tiling(TilingSettings(), *some, Poses.open(Path(poses))))
    key = pieces[0].key
    tiles(TilesSettings(), Parts([((("session", "a"), ("tile", key)), pieces[0].product)]))
    time.sleep(1.0)


def _pieces(number: int, scans: str, labels: str, poses: str, folder: str) -> int:
    """Pieces of one chunk, as files; points in it."""
    deskewed = Deskewed.open(Path(scans))
    out = Path(folder) / f"{number:04d}"
    out.mkdir()
    for part in tiling(TilingSettings(), deskewed, FinalLabels.open(Path(labels)), Poses.open(Path(poses))):
        part.product.write(out / f"{part.key}.parquet")
    return sum(int(item["rows"]) for item in deskewed.index)


def _tile(name: str, pieces: str, out: str) -> int:
    """One tile of the pieces of all chunks, as files; points in it."""
    tile, removed, files = tiles(TilesSettings(), _pieces_of(name, Path(pieces)))
    tile.write(Path(out) / "tiles" / f"{name}.parquet")
    removed.write(Path(out) / "tiles" / f"{name}.removed")
    files.write(Path(out) / "tiles" / name)
    return len(tile)


def _pieces_of(name: str, pieces: Path) -> Parts[Piece]:
    found: Paths = [
        ((("session", "a"), ("chunk", path.parent.name), ("tile", name)), path)
        for path in sorted(pieces.glob(f"*/{name}.parquet"))
    ]
    return Parts(found, load=Piece.open)


def sized(pieces: Path, million: float, out: Path) -> Iterator[Figure]:
    """Memory and time of tiles and overview for a map of so many million points, each in a process of its own."""
    scope = f"map_{million:g}m"
    made = _alone(_repeat, str(pieces), million, str(out))
    how = f"{made['points']} points in {made['tiles']} tiles, one process after the other"
    yield Figure(f"bench.tiling.{scope}.tiles_peak_rss_mb", made["peak_mb"], "MB", scope, how)
    yield Figure(
        f"bench.tiling.{scope}.tiles_points_per_s",
        made["points"] / made["wall_s"],
        "1/s",
        scope,
        f"{how}: merge and write",
    )
    seen = _alone(_oversee, str(out))
    yield Figure(f"bench.tiling.{scope}.overview_peak_rss_mb", seen["peak_mb"], "MB", scope, how)
    yield Figure(f"bench.tiling.{scope}.overview_s", seen["wall_s"], "s", scope, how)


def _alone(task: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What a task says, with the wall time and the peak memory of the process it ran in."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measured, (task, arguments))


def _measured(task: Callable[..., dict[str, Any]], arguments: Sequence[Any]) -> dict[str, Any]:
    started = time.monotonic()
    said = task(*arguments)
    return {**said, "wall_s": time.monotonic() - started, "peak_mb": _peak_mb()}


def _peak_mb() -> float:
    """Of this process alone; what `getrusage` tells outlives a start from a larger process."""
    (line,) = (row for row in Path("/proc/self/status").read_text().splitlines() if row.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def _repeat(pieces: str, million: float, out: str) -> dict[str, Any]:
    """The tiles of the pieces, made anew for every copy, until there are points enough."""
    folder, names = Path(out), sorted({path.stem for path in Path(pieces).rglob("*.parquet")})
    (folder / "tiles").mkdir(parents=True)
    at = np.array([tile_position(name) for name in names])
    low, width = at.min(axis=0), np.ptp(at, axis=0) + 1
    points = made = copy = 0
    while points < million * 1e6:
        shift = np.array(_square(copy)) * width - low
        for name, position in zip(names, at, strict=True):
            x, y = (position + shift).tolist()
            tile, _, _ = tiles(TilesSettings(), _pieces_of(name, Path(pieces)))
            moved = replace(tile, offset_m=(x * tile.tile_size_m, y * tile.tile_size_m, 0.0))
            moved.write(folder / "tiles" / f"{tile_name(x, y)}.parquet")
            points, made = points + len(tile), made + 1
        copy += 1
    return {"points": points, "tiles": made}


def _square(n: int) -> tuple[int, int]:
    """Place of the n-th copy: squares that grow by a row and a column."""
    side = int(np.sqrt(n))
    rest = n - side * side
    return (side, rest) if rest <= side else (2 * side - rest, side)


def _oversee(out: str) -> dict[str, Any]:
    """Index, overview and map.ply of the tiles, and a header: a map that opens."""
    folder = Path(out)
    found: Paths = [((("tile", path.stem),), path) for path in sorted((folder / "tiles").glob("*.parquet"))]
    index, cloud, files = overview(OverviewSettings(), Parts(found, load=Tile.open), Parts[RemovedTile]([]))
    index.write(folder / "tiles" / "index.parquet")
    cloud.write(folder / "tiles" / "overview.parquet")
    files.write(folder)
    (folder / "map.json").write_text(json.dumps(_header(folder.name, index), indent=1))
    return {}


def _header(name: str, index: TileIndex) -> dict[str, Any]:
    low, high = index.bounds_m.tolist()
    return {
        "format": "scanloom map 1", "name": name, "version": 1, "parent": None, "frame": index.frame,
        "crs": index.georeference, "epsg": (index.georeference or {}).get("epsg"), "origin": index.georeference,
        "bounds_m": {"min": low, "max": high}, "points": int(index.points.sum()), "tile_size_m": index.tile_size_m,
        "voxel_size_m": index.voxel_size_m, "sessions": [], "files": {},
    }  # fmt: skip


def exported(folder: Path, names: Sequence[str], scratch: Path) -> Iterator[Figure]:
    """Points a second of each format, in a process of its own."""
    for name in names:
        said = _alone(_export, str(folder), name, str(scratch / name))
        how = f"{said['points']} points, {said['mb']:.1f} MB, one process"
        yield Figure(
            f"bench.tiling.export.{name}.points_per_s", said["points"] / said["wall_s"], "1/s", "map", how
        )
        yield Figure(f"bench.tiling.export.{name}.peak_rss_mb", said["peak_mb"], "MB", "map", how)


def _export(folder: str, name: str, out: str) -> dict[str, Any]:
    from scanloom.stages.exports.formats import FORMATS, Options
    from scanloom.stages.exports.source import MapSource

    source, to = MapSource.open(Path(folder)), Path(out)
    to.mkdir(parents=True)
    files = FORMATS[name].write(source, to, Options())
    return {"points": source.points, "mb": sum(path.stat().st_size for path in files) / 1e6}


if __name__ == "__main__":
    main()
