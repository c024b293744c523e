"""The fleet file: globs, groups, and clear errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from scanloom.schemas.errors import UsageError
from scanloom.workflows.fleet import read_fleet, sessions_by_map


def _fleet(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "fleet.yaml"
    path.write_text(text)
    return path


def test_globs_and_groups(tmp_path: Path) -> None:
    for name in ("b.mcap", "a.mcap", "c.bag"):
        (tmp_path / name).touch()
    fleet = read_fleet(
        _fleet(tmp_path, "maps: {depot: {sessions: ['*.mcap', sample]}}\neach: ['*.bag', 'gone.bag']\n")
    )
    assert sessions_by_map(fleet, tmp_path) == {
        "depot": [str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap"), "sample"],
        "c": [str(tmp_path / "c.bag")],
        "gone": [str(tmp_path / "gone.bag")],
    }


def test_equal_names_stay_apart(tmp_path: Path) -> None:
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "drive.bag").touch()
    maps = sessions_by_map(read_fleet(_fleet(tmp_path, "each: ['*/drive.bag']\n")), tmp_path)
    assert list(maps) == ["drive", "drive-2"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("maps: {a: {session: [x]}}", "maps.a"),
        ("maps: {a: {sessions: []}}", r"maps\.a\.sessions"),
        ("", "names no logs"),
        ("maps: [", "not YAML"),
        ("map: {}", "known entries"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        read_fleet(_fleet(tmp_path, text))


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.yaml"):
        read_fleet(tmp_path / "none.yaml")
