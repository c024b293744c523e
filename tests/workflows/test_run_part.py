"""What a report says of its run: which settings were changed."""

from __future__ import annotations

from scanloom.workflows.run_part import changed_settings


def test_settings_that_have_their_default_are_not_listed() -> None:
    given = {"tiling": {"voxel_size_m": 0.25}, "picture": {"longest_px": 1600}}
    rows = changed_settings(given, {"mon": {"picture": {"longest_px": 800}}, "tue": {}})
    assert [(row.name, row.value, row.default, row.session) for row in rows] == [
        ("tiling.voxel_size_m", "0.25", "0.1", ""),
        ("picture.longest_px", "800", "1600", "mon"),
    ]
    assert all(row.doc for row in rows)


def test_a_run_without_settings_has_none_to_list() -> None:
    assert changed_settings({}, {}) == []
