"""The comparison on screen and as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.comparison import SYSTEMS, Result
from benchmarks.scores import Figure

COLUMNS = {
    "rpe1_m": "RPE 1 m", "rpe5_m": "5 m", "rpe10_m": "10 m", "rpe20_m": "20 m", "kitti_t_rel_percent": "t_rel %",
    "kitti_r_rel_deg_per_100m": "r_rel deg/100m", "ate_m": "ATE m", "nees": "NEES", "ms_per_frame": "ms",
    "ms_per_frame_p95": "ms p95", "deskew_ms_per_frame": "deskew ms", "sensors_ms_per_session": "sensors ms", "threads": "threads", "peak_rss_mb": "MB",
    "unreliable_scans": "bridged", "lost_scans": "lost",
}  # fmt: skip
SUMMARY = (
    ".ratio.",
    ".time_ratio.",
    ".tunnel.axis",
    ".tunnel.error",
    ".tunnel.worse",
    ".pairs.",
    "bench.deskew.",
)
LENGTHS_M = (1, 5, 10, 20)
COLOURS = {
    "scanloom": "#1b7f5c", "kiss_icp": "#d1802b", "small_gicp": "#4a6fb5", "vgicp_on_our_scans": "#9db4dd",
}  # fmt: skip
Chosen = Mapping[tuple[str, str], Result]


def comparison(chosen: Chosen) -> Table:
    """One row per sequence and system."""
    table = Table(title="odometry: errors in m over a length of path, time per frame")
    for title in ("sequence", "system", "variant", *COLUMNS.values()):
        table.add_column(title, no_wrap=True)
    for (sequence, system), result in chosen.items():
        cells = [_cell(result.value(name)) for name in COLUMNS]
        table.add_row(sequence, system, result.variant, *cells, end_section=system == SYSTEMS[-1])
    return table


def summary(figures: Sequence[Figure]) -> Table:
    """What is asked of odometry as a whole."""
    table = Table(title="together")
    for title in ("figure", "value", "unit", "how"):
        table.add_column(title)
    for figure in figures:
        if any(part in figure.name for part in SUMMARY):
            table.add_row(figure.name, _cell(figure.value), figure.unit, figure.method)
    return table


def picture(chosen: Chosen, path: Path) -> None:
    """RPE over each length, bars per sequence and system."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    sequences = list(dict.fromkeys(sequence for sequence, _ in chosen))
    names = [system for system in SYSTEMS if any(found == system for _, found in chosen)]
    figure, axes = pyplot.subplots(
        len(LENGTHS_M), 1, figsize=(1.5 * len(sequences) + 3, 9), sharex=True, squeeze=False
    )
    width = 0.8 / max(len(names), 1)
    for axis, length in zip(axes[:, 0], LENGTHS_M):
        for k, system in enumerate(names):
            values = [_error(chosen, sequence, system, length) for sequence in sequences]
            place = np.arange(len(sequences)) + (k - (len(names) - 1) / 2) * width
            axis.bar(place, values, width, color=COLOURS[system], label=system)
        axis.set_yscale("log")
        axis.set_ylabel(f"RPE {length} m [m]")
        axis.grid(axis="y", alpha=0.3)
    axes[0, 0].legend(ncols=len(names), frameon=False, loc="upper left")
    axes[-1, 0].set_xticks(np.arange(len(sequences)), sequences)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _error(chosen: Chosen, sequence: str, system: str, length_m: int) -> float:
    result = chosen.get((sequence, system))
    return result.value(f"rpe{length_m}_m") if result else float("nan")


def _cell(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else ""
