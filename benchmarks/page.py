"""The figures of a run, written into a page of the documentation between two marks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.comparison import OURS, PEERS, SYSTEMS

START, END = "<!-- figures of make bench: start -->", "<!-- figures of make bench: end -->"
PREFIX = "bench.odometry."
COLUMNS = {
    "rpe1_m": "RPE 1 m", "rpe5_m": "5 m", "rpe10_m": "10 m", "rpe20_m": "20 m", "kitti_t_rel_percent": "t_rel %",
    "kitti_r_rel_deg_per_100m": "r_rel deg/100 m", "ate_m": "ATE m", "nees": "NEES", "ms_per_frame": "ms",
    "ms_per_frame_p95": "p95 ms", "deskew_ms_per_frame": "deskew ms", "sensors_ms_per_session": "sensors ms, once",
    "peak_rss_mb": "MB",
}  # fmt: skip
TARGETS = {
    "ratio.kiss_icp": "at most 0.75", "ratio.kiss_icp.worst": "at most 1", "ratio.kiss_icp.simulated": "at most 0.5",
    "ratio.small_gicp": "at most 0.95", "ratio.small_gicp.worst": "at most 1", "ratio.vgicp_on_our_scans": "",
    "ratio.vgicp_on_our_scans.worst": "", "time_ratio.odometry": "at most 0.8", "time_ratio.odometry.worst": "",
    "time_ratio.with_deskew": "at most 1.2", "time_ratio.with_deskew.worst": "",
    "tunnel.axis_flagged_inside": "at least 0.95", "tunnel.axis_flagged_walls_only": "", "tunnel.axis_flagged_street": "below 0.02",
    "tunnel.error_percent": "below 0.5", "tunnel.error_off_percent": "", "tunnel.worse_without": "at least 3",
    "pairs.auc_e1": "more than D", "pairs.auc_d": "", "pairs.auc_d_unscaled": "", "pairs.auc_e2": "", "pairs.auc_e3": "",
    "pairs.auc_rmse": "", "pairs.auc_inlier_ratio": "", "pairs.auc_least_p": "", "pairs.matching": "2000",
    "pairs.non_matching": "2000", "pairs.registered_right": "",
}  # fmt: skip
DESKEW = {
    "wall_rms_m": "below 0.02", "wall_raw_rms_m": "", "identity_is_exact": "1", "newer_range_median_m": "within 0.03",
    "newer_range_p95_m": "within 0.03", "newer_turning_range_median_m": "", "newer_turning_range_p95_m": "",
}  # fmt: skip
Row = Mapping[str, Any]


def fill(page: Path, rows: Sequence[Row], remark: str) -> None:
    """Put the figures between the marks of `page`."""
    before, rest = page.read_text().split(START)
    _, after = rest.split(END)
    page.write_text(f"{before}{START}\n\n{chr(10).join(tables(rows, remark))}\n{END}{after}")


def tables(rows: Sequence[Row], remark: str) -> Iterator[str]:
    """Lines of Markdown: by sequence and system, then all together."""
    by_name = {row["name"]: row for row in rows}
    yield remark
    yield ""
    yield from _sequences(by_name)
    yield ""
    yield from _ratios(by_name)
    yield ""
    yield from _table({f"{PREFIX}{name}": target for name, target in TARGETS.items()}, by_name)
    yield ""
    yield from _table({f"bench.deskew.{name}": target for name, target in DESKEW.items()}, by_name)


def _sequences(by_name: Mapping[str, Row]) -> Iterator[str]:
    yield f"| sequence | system | {' | '.join(COLUMNS.values())} |"
    yield "|" + "---|" * (2 + len(COLUMNS))
    for sequence in sequences(by_name):
        for system in SYSTEMS:
            cells = [_cell(by_name.get(f"{PREFIX}{sequence}.{system}.{name}")) for name in COLUMNS]
            if any(cells):
                yield f"| {sequence} | {system} | {' | '.join(cells)} |"


def _ratios(by_name: Mapping[str, Row]) -> Iterator[str]:
    """Ours over each peer, sequence by sequence, and in words where a peer is the better one."""
    yield f"| error over 10 m, ours over that of | {' | '.join(PEERS)} |"
    yield "|" + "---|" * (1 + len(PEERS))
    for sequence in sequences(by_name):
        cells = [_cell(by_name.get(f"{PREFIX}ratio.{peer}.{sequence}")) for peer in PEERS]
        if any(cells):
            yield f"| {sequence} | {' | '.join(cells)} |"
    for peer in PEERS:
        if f"{PREFIX}ratio.{peer}" in by_name:
            yield ""
            yield f"`{peer}` is better than ours on {', '.join(_better(peer, by_name)) or 'none of them'}."


def _better(peer: str, by_name: Mapping[str, Row]) -> Iterator[str]:
    for sequence in sequences(by_name):
        row = by_name.get(f"{PREFIX}ratio.{peer}.{sequence}")
        if row and float(row["value"]) > 1:
            ours, theirs = (by_name[f"{PREFIX}{sequence}.{s}.rpe10_m"]["value"] for s in (OURS, peer))
            yield f"`{sequence}` ({_cell(row)} times as good, by {1e3 * (ours - theirs):.2g} mm over 10 m)"


def sequences(by_name: Mapping[str, Row]) -> list[str]:
    """Sequences that have figures of any system."""
    parts = [name.removeprefix(PREFIX).split(".") for name in by_name if name.startswith(PREFIX)]
    return list(dict.fromkeys(part[0] for part in parts if len(part) == 3 and part[1] in SYSTEMS))


def _table(wanted: Mapping[str, str], by_name: Mapping[str, Row]) -> Iterator[str]:
    yield "| figure | value | wanted | how |"
    yield "|---|---|---|---|"
    for name, target in wanted.items():
        if name in by_name:
            row = by_name[name]
            value = f"{_cell(row)} {row['unit']}".strip()
            yield f"| `{name}` | {value} | {target} | {row['method']} |"


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    value = float(row["value"])
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
