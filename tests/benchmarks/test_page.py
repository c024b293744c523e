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
