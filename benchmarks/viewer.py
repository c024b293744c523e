"""The viewer: how long until a large map is seen, and what the server needs for it.

`python -m benchmarks.viewer MAP [--repeat N] [--keep FOLDER] [--json -]` opens a delivered map in a browser without a screen; with
`--repeat` the map is laid out N times side by side first, its tiles as links, so that a hundred million points cost little disk.
The browser draws by software here: frames are slow, what is measured is what the server and the page do until points are seen.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil

from benchmarks.figures import published
from benchmarks.scores import Figure
from scanloom.schemas.product import columns_of
from scanloom.schemas.tiles import Overview, TileIndex
from tests.browser import Page, chromium

SEEN = "window.scanloom && scanloom.cloud.shown > 0"
DRAWN = "!scanloom.dirty && !scanloom.stale && scanloom.view.drawingTook() !== null"
DONE = f"{SEEN} && !scanloom.cloud.busy && {DRAWN}"


def main() -> None:
    options = _options()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.map
        if options.repeat > 1:
            folder = options.keep or Path(scratch) / "map"
            if not folder.exists():
                repeated(options.map, folder, options.repeat)
        points = json.loads((folder / "map.json").read_text())["points"]
        published(list(figures(folder, f"{points / 1e6:.0f} million points")), options.json)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, help="folder of a finished map")
    parser.add_argument("--repeat", type=int, default=1, help="times the map is laid out side by side")
    parser.add_argument("--keep", type=Path, help="where the repeated map is kept")
    parser.add_argument("--json", default="", help="file, or - for standard output")
    return parser.parse_args()


def figures(folder: Path, size: str) -> Iterator[Figure]:
    """Times and memory of one opening."""

    def figure(name: str, value: float, unit: str, method: str) -> Figure:
        return Figure(f"viewer.{name}", value, unit, "map", f"{method}; {size}")

    started = time.monotonic()
    with served(folder) as (url, process):
        yield figure(
            "ready_s", time.monotonic() - started, "s", "from the command to the address being served"
        )
        with chromium() as page:
            page.resize(1400, 900)
            opened = time.monotonic()
            page.open(url)
            page.wait(SEEN)
            seen = time.monotonic() - opened
            yield figure("first_points_s", seen, "s", "from opening the address to points in the picture")
            page.wait(DONE, 300)
            yield figure(
                "settled_s", time.monotonic() - opened, "s", "until the whole map is as fine as the screen"
            )
            yield figure(
                "shown_points", float(page.run("scanloom.cloud.shown")), "", "points in that picture"
            )
            yield figure(
                "zoomed_s",
                _zoomed(page),
                "s",
                "after a jump to a place five metres above it, until it is settled",
            )
            assert page.errors() == [], page.errors()
        yield figure(
            "server_rss_mb", process.memory_info().rss / 1e6, "MB", "resident memory of the server after that"
        )
        yield figure(
            "tileset_kb",
            len(urllib.request.urlopen(f"{url}data/tileset/tileset.json").read()) / 1e3,
            "kB",
            "of the tree",
        )


def _zoomed(page: Page) -> float:
    page.run(
        "(() => { const v = scanloom.view, c = v.control, p = scanloom.low.clone().lerp(scanloom.high, 0.5);"
        " const part = [...scanloom.cloud.parts()][0]; const at = part.geometry.attributes.position;"
        " p.fromBufferAttribute(at, 0).applyMatrix4(part.matrixWorld); c.target.copy(p);"
        " v.perspective.position.set(p.x, p.y - 5, p.z + 5); c.update(); scanloom.dirty = true; })()"
    )
    began = time.monotonic()
    page.run(
        "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => requestAnimationFrame(done))))"
    )
    page.wait(DONE, 300)
    return time.monotonic() - began


@contextmanager
def served(folder: Path) -> Iterator[tuple[str, psutil.Process]]:
    """`scanloom view` in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "scanloom.workflows.cli",
        "view",
        str(folder),
        "--port",
        "0",
        "--no-browser",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        line = (process.stderr or sys.stdin).readline()
        found = re.search(r"http://\S+", line)
        assert found, line
        yield found[0], psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait()


def repeated(source: Path, folder: Path, times: int) -> None:
    """A map of so many copies of another in a square, with an index and an overview of its own; tiles are links."""
    index = TileIndex.open(source / "tiles" / "index.parquet")
    place = np.array([name.split("_") for name in index.names], int)
    step = np.ptp(place, axis=0) + 1
    across = int(np.ceil(np.sqrt(times)))
    shifts = [(i % across, i // across) * step for i in range(times)]
    (folder / "tiles").mkdir(parents=True)
    parts = []
    for shift in shifts:
        new = {name: f"{x}_{y}" for name, (x, y) in zip(index.names, place + shift)}
        for old, name in new.items():
            os.link((source / "tiles" / f"{old}.parquet").resolve(), folder / "tiles" / f"{name}.parquet")
        move = np.append(shift, 0) * index.tile_size_m
        parts.append(
            replace(
                index, tile=np.array([new[str(t)] for t in index.tile], object), min_m=index.min_m + move, max_m=index.max_m + move
            )
        )  # fmt: skip
    whole = TileIndex.concatenate(parts)
    whole.write(folder / "tiles" / "index.parquet")
    _overview(source, whole, times).write(folder / "tiles" / "overview.parquet")
    header = json.loads((source / "map.json").read_text())
    low, high = whole.min_m.min(axis=0).tolist(), whole.max_m.max(axis=0).tolist()
    header |= {"points": int(whole.points.sum()), "bounds_m": {"min": low, "max": high}, "files": {}}
    (folder / "map.json").write_text(json.dumps(header))
    os.link((source / "trajectory.parquet").resolve(), folder / "trajectory.parquet")


def _overview(source: Path, whole: TileIndex, times: int, most: int = 4_000_000) -> Overview:
    """The coarsest levels of the copies, as many as fit."""
    one = Overview.open(source / "tiles" / "overview.parquet")
    counts = np.bincount(one.level)
    lowest = int(np.argmax(np.cumsum(counts[::-1])[::-1] * times <= most))
    one = one.take(one.level >= lowest)
    tiles = len(whole.names) // times
    copies = [replace(one, tile=(one.tile + i * tiles).astype(np.int32)) for i in range(times)]
    joined = Overview.concatenate(copies)
    order = np.lexsort((joined.tile, joined.level.max() - joined.level))
    assert set(columns_of(Overview)) >= {"level", "tile"}
    return joined.take(order)


if __name__ == "__main__":
    main()
