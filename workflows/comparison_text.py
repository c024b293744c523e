"""A comparison as a table for the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from scanloom.workflows.compare_maps import Comparison, OneWay, Setting
from scanloom.workflows.metric_changes import Change
from scanloom.workflows.noise import Noise

_WORDS = {"regression": "WORSE", "better": "better", "same": "", "changed": ""}
_ARROWS = {"lower": "↓", "higher": "↑", "target": "◎", "": ""}
_LONGEST = 44


def text_of_comparison(found: Comparison) -> str:
    """Everything that differs, the worst first; equal figures that are not judged are counted only."""
    blocks = [
        _verdict(found),
        *(f"note: {note}" for note in found.notes),
        _metric_table(found.metrics),
        _path_table(found),
        _point_table(found),
        _pairs("settings and versions that differ", found.settings) or "settings and versions: the same",
        _pairs("sizes", found.sizes),
    ]
    return "\n\n".join(block for block in blocks if block)


def text_of_noise(noise: Noise) -> str:
    """Metrics that vary from run to run, the most variable first."""
    rows = [
        (name if not session else f"{name} [{session}]", _number(s.mean), _number(s.deviation), _number(noise.tolerance((name, session))))
        for (name, session), s in sorted(
            noise.spreads.items(), key=lambda item: -item[1].deviation / max(abs(item[1].mean), 1e-12)
        )
        if s.deviation > 0.0
    ]  # fmt: skip
    still = sum(s.deviation == 0.0 for s in noise.spreads.values())
    head = ("metric", "mean", "deviation", "allowed")
    return _table(head, rows) + f"\n{still} metrics were the same in all {len(noise.maps)} runs"


def _verdict(found: Comparison) -> str:
    worse = found.regressions
    lines = [f"A  {found.a.folder}", f"B  {found.b.folder}"]
    judged = [change for change in found.metrics if change.allowed is not None]
    by_noise = sum(change.source == "noise" for change in judged)
    if worse:
        named = ", ".join(change.label for change in worse[:4]) + (", ..." if len(worse) > 4 else "")
        lines.append(f"B is worse than A in {len(worse)} of {len(judged)} judged metrics: {named}")
    elif judged:
        better = sum(change.verdict == "better" for change in judged)
        lines.append(
            f"B is no worse than A in any of {len(judged)} judged metrics, and better in {better} of them"
        )
    if judged:
        lines.append(f"(allowed by measured noise: {by_noise} metrics, by default: {len(judged) - by_noise})")
    return "\n".join(lines)


def _metric_table(changes: Sequence[Change]) -> str:
    order = {"regression": 0, "better": 1, "only in A": 3, "only in B": 3, "changed": 4}
    shown = [c for c in changes if not (c.verdict == "same" and c.before == c.after)]
    shown.sort(key=lambda c: order.get(c.verdict, 2))
    hidden = len(changes) - len(shown)
    rows = [
        (
            c.label, _ARROWS[c.better], "truth" if c.truth else "", _number(c.before), _number(c.after), _change(c),
            _number(c.allowed) + ("*" if c.source == "noise" else ""), c.unit, _WORDS.get(c.verdict, c.verdict),
        )
        for c in shown
    ]  # fmt: skip
    head = ("metric", "", "needs", "A", "B", "B - A", "allowed", "unit", "")
    legend = "↑ higher is better, ↓ lower, ◎ nearer to its best value; allowed: how much worse is no regression, * measured noise"
    table = _table(head, rows) + "\n" + legend if rows else "metrics: all the same"
    return table + (f"\n{hidden} more metrics are equal in both" if hidden and rows else "")


def _change(change: Change) -> str:
    if change.before is None or change.after is None:
        return ""
    difference = change.after - change.before
    return f"{'+' if difference > 0 else ''}{_number(difference)}"


def _path_table(found: Comparison) -> str:
    if not found.paths:
        return ""
    rows = [
        (
            name, str(p.scans), _number(p.as_they_stand_rms_m), _number(p.shift_m), _number(p.shift_deg),
            _number(p.aligned_rms_m), _number(p.aligned_max_m), _number(p.aligned_rms_deg),
        )
        for name, p in found.paths.items()
    ]  # fmt: skip
    head = (
        "trajectory",
        "scans",
        "apart m",
        "shift m",
        "shift deg",
        "aligned rms m",
        "max m",
        "rms deg",
    )
    return _table(head, rows) + "\napart: as the maps lie; aligned: once the shift of the whole is undone"


def _point_table(found: Comparison) -> str:
    ways: Iterable[tuple[str, OneWay | None]] = (("A to B", found.a_to_b), ("B to A", found.b_to_a))
    rows = [
        (name, str(w.samples), _number(w.median_m), _number(w.p95_m), f"{100 * w.only_share:.2f} %")
        for name, w in ways
        if w is not None
    ]
    head = ("points to their nearest", "samples", "median m", "95 % m", "only there")
    return (
        _table(head, rows) + "\nafter the shift of the whole; only there: none within 0.5 m" if rows else ""
    )


def _pairs(title: str, rows: Sequence[Setting]) -> str:
    return _table((title, "A", "B"), [(row.name, row.a, row.b) for row in rows]) if rows else ""


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns as wide as they need to be; all but the first to the right where they are numbers."""
    return "\n".join(_lines([head, *rows]))


def _lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    widths[0] = min(max(widths[0], 1), _LONGEST * 2)
    for row in rows:
        cells = [row[0].ljust(widths[0])] + [
            cell.rjust(width) for cell, width in zip(row[1:], widths[1:]) if width
        ]
        yield "  ".join(cells).rstrip()


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
