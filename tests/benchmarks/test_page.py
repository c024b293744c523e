"""Figures on their way into the documentation."""

from __future__ import annotations

from pathlib import Path

from benchmarks.page import END, START, fill

ROWS = [
    {"name": "bench.odometry.town.scanloom.rpe10_m", "value": 0.01234, "unit": "m", "method": "rms"},
    {"name": "bench.odometry.town.kiss_icp.rpe10_m", "value": 0.1, "unit": "m", "method": "rms"},
    {"name": "bench.odometry.town.kiss_icp.raw.rpe10_m", "value": 0.777, "unit": "m", "method": "rms"},
    {"name": "bench.odometry.ratio.kiss_icp", "value": 0.1234, "unit": "", "method": "mean"},
    {"name": "bench.deskew.wall_rms_m", "value": 0.0075, "unit": "m", "method": "wall"},
]


def test_figures_replace_what_is_between_the_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"above\n{START}\nold\n{END}\nbelow\n")
    fill(page, ROWS, "Measured today.")
    text = page.read_text()
    assert text.startswith("above\n") and text.endswith("\nbelow\n")
    assert "old" not in text and "0.777" not in text
    lines = text.splitlines()
    assert "Measured today." in lines
    assert (
        next(line for line in lines if line.startswith("| town | scanloom |")).split("|")[5].strip()
        == "0.0123"
    )
    assert "| `bench.odometry.ratio.kiss_icp` | 0.123 | at most 0.75 | mean |" in lines
    assert "| `bench.deskew.wall_rms_m` | 0.0075 m | below 0.02 | wall |" in lines
    fill(page, ROWS, "Measured today.")
    assert page.read_text() == text


def test_the_page_says_where_a_peer_is_better(tmp_path: Path) -> None:
    row = {"unit": "", "method": ""}
    values = {
        "town.scanloom.rpe10_m": 0.005, "town.vgicp_on_our_scans.rpe10_m": 0.004,
        "town.small_gicp.rpe10_m": 0.01, "ratio.small_gicp": 0.5, "ratio.small_gicp.town": 0.5,
        "ratio.vgicp_on_our_scans": 1.25, "ratio.vgicp_on_our_scans.town": 1.25,
    }  # fmt: skip
    rows = [{"name": f"bench.odometry.{name}", "value": value, **row} for name, value in values.items()]
    page = tmp_path / "page.md"
    page.write_text(f"{START}{END}")
    fill(page, rows, "Measured today.")
    lines = page.read_text().splitlines()
    assert "| town |  | 0.5 | 1.25 |" in lines
    assert "`small_gicp` is better than ours on none of them." in lines
    better = "`vgicp_on_our_scans` is better than ours on `town` (1.25 times as good, by 1 mm over 10 m)."
    assert better in lines
    assert not [line for line in lines if line.startswith("`kiss_icp` is")]
