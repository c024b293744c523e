"""What it takes to describe a keyframe."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from benchmarks.places_worlds import World
from benchmarks.scores import Figure
from scanloom.schemas.scans import DeskewedScan, ScanLabels
from scanloom.stages.loops.places import FIRST_LEFT_OUT, Settings, describe
from scanloom.stages.loops.scan_context import scan_contexts

SCANS = 40


def figures(w: World) -> Iterator[Figure]:
    """Median time per keyframe of the scan context alone and of all descriptors, computing on one core."""
    step = max(len(w.track) // SCANS, 1)
    scans = [w.shelf.read(int(index)) for index in w.track.scan_index[::step]]
    points = int(np.median([len(scan) for scan, _ in scans]))
    settings = Settings()

    def alone(scan: DeskewedScan, label: ScanLabels) -> None:
        drawn = label.class_ < FIRST_LEFT_OUT
        scan_contexts(
            scan.x_m, scan.y_m, scan.z_m, drawn, settings.max_radius_m, settings.height_offset_m, (0.0,)
        )

    def everything(scan: DeskewedScan, label: ScanLabels) -> None:
        describe(settings, scan, label)

    for name, work in (("scan_context", alone), ("all", everything)):
        how = f"median of {len(scans)} keyframes of {points} points (median), computing on one core"
        yield Figure(f"loops.{w.name}.describe_ms.{name}", _median_ms(work, scans), "ms", w.name, how)


def _median_ms(
    work: Callable[[DeskewedScan, ScanLabels], None], scans: list[tuple[DeskewedScan, ScanLabels]]
) -> float:
    work(*scans[0])
    times = []
    for scan, label in scans:
        started = time.process_time()
        work(scan, label)
        times.append(time.process_time() - started)
    return 1e3 * float(np.median(times))
