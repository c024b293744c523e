"""How good a map is: metrics, and the report's pure parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scanloom.schemas.product import Files, Table, column


@dataclass(frozen=True)
class Metrics(Table):
    """One row per metric. Names are stable and dotted; `metrics.METRICS` says how to read each."""

    NAME: ClassVar[str] = "metrics"
    SCHEMA_VERSION: ClassVar[int] = 2

    name: NDArray[np.object_] = column("str", "stable dotted name, for instance `fusion.ate_rmse_m`")
    value: NDArray[np.float64] = column("f8", "the figure")
    unit: NDArray[np.object_] = column("str", "unit, empty for a plain number")
    scope: NDArray[np.object_] = column("str", "`scan`, `session`, `map` or `run`")
    session: NDArray[np.object_] = column("str", "session it concerns; empty for a map")
    method: NDArray[np.object_] = column("str", "how it was computed, in words")
    samples: NDArray[np.int64] = column(
        "i8", "from how many samples it was computed; -1 for a plain count of all"
    )
    truth: NDArray[np.bool_] = column("?", "truth was needed to compute it")


@dataclass(frozen=True)
class ErrorTrack(Table):
    """One row per scan with truth: the error of odometry and of the map's poses, for plots."""

    NAME: ClassVar[str] = "error_track"
    SPLIT_BY: ClassVar[str] = "session"

    stamp_ns: NDArray[np.int64] = column("i8", "reference time of the scan", unit="ns")
    travelled_m: NDArray[np.float64] = column("f8", "path length so far, from truth", unit="m")
    odometry_error_m: NDArray[np.float64] = column(
        "f8", "distance to truth, odometry aligned at the first scan", unit="m"
    )
    fusion_error_m: NDArray[np.float64] = column("f8", "distance to truth, map aligned as a whole", unit="m")


@dataclass(frozen=True)
class PictureFiles(Files):
    """The map from above: `preview.png` with the trajectory on it; by height, intensity and class without it; `overlay.svg`
    the marks alone, `left_out.png` what is not in the map, `view.json` where in the map the pictures lie."""

    NAME: ClassVar[str] = "picture_files"


@dataclass(frozen=True)
class ReportFiles(Files):
    """`body.html`: what a report shows that does not vary from run to run."""

    NAME: ClassVar[str] = "report_files"
