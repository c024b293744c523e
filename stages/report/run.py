"""The part of a report that varies from run to run: times and memory, changed settings, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from scanloom.stages.report.plots import NOTHING, Plot, Trace, axis, plain
from scanloom.stages.report.templates import render

_MOST_FILES = 150
_BAR_PX, _AROUND_PX = 22, 64


@dataclass(frozen=True)
class StageTime:
    """Tasks of one stage, those computed in this run, the sum of their times and the largest memory of one."""

    stage: str
    tasks: int = 0
    executed: int = 0
    wall_s: float = 0.0
    peak_rss_mb: float = 0.0

    def plus(self, executed: bool, wall_s: float, peak_rss_mb: float) -> StageTime:
        """With one task more; the time of one found in the store is no part of this run."""
        if not executed:
            return replace(self, tasks=self.tasks + 1)
        peak_mb = max(self.peak_rss_mb, peak_rss_mb)
        return StageTime(self.stage, self.tasks + 1, self.executed + 1, self.wall_s + wall_s, peak_mb)


@dataclass(frozen=True)
class Changed:
    """A setting that is not the default; of one session, or of all when `session` is empty."""

    name: str
    value: str
    default: str
    session: str = ""
    doc: str = ""


@dataclass(frozen=True)
class Log:
    """A log of the map with the SHA-256 of its files; empty for a simulated one."""

    session: str
    sha256: str
    scans: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class File:
    """A file of the map."""

    name: str
    sha256: str
    size: int


@dataclass(frozen=True)
class Run:
    """All of it."""

    stages: Sequence[StageTime] = ()
    settings: Sequence[Changed] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    logs: Sequence[Log] = ()
    files: Sequence[File] = ()


def run_section(run: Run) -> str:
    """The last sections of the page."""
    computed = [row for row in run.stages if row.executed]
    return render(
        "run.html",
        run=run,
        total_s=sum(row.wall_s for row in run.stages),
        times=_bars("Time of each stage", "time, s", computed, [row.wall_s for row in computed], "--accent", 2),
        memory=_bars(
            "Peak memory of a task of each stage", "peak memory, MB", computed, [row.peak_rss_mb for row in computed], "--curve-3", 0
        ),
        files=run.files[:_MOST_FILES],
        other_files=max(len(run.files) - _MOST_FILES, 0),
        all_bytes=sum(file.size for file in run.files),
    )  # fmt: skip


def _bars(
    label: str, title: str, rows: Sequence[StageTime], values: Sequence[float], colour: str, digits: int
) -> Plot:
    """A bar for each stage, the first on top."""
    if not rows:
        return NOTHING
    unit = title.rpartition(" ")[2]
    bars: Trace = {
        "type": "bar", "orientation": "h", "y": [plain(row.stage) for row in rows], "x": [round(v, digits) for v in values],
        "marker": {"color": colour}, "hovertemplate": f"%{{y}}: %{{x}} {unit}<extra></extra>",
        "text": [f"{v:.{digits}f}" for v in values], "textposition": "outside", "cliponaxis": False,
    }  # fmt: skip
    y_axis = {"autorange": "reversed", "showgrid": False, "ticks": "", "fixedrange": True}
    height = _BAR_PX * len(rows) + _AROUND_PX
    return Plot(
        label,
        [bars],
        {"xaxis": axis(title, range=[0, 1.16 * max(*values, 1e-3)]), "yaxis": y_axis, "bargap": 0.3},
        "bars",
        "",
        {"height": height},
    )
