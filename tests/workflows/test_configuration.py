"""Settings layers and what is said when one is wrong."""

from __future__ import annotations

import pytest

from scanloom.schemas.errors import UsageError
from scanloom.workflows.configuration import command_line_settings, merged, project_settings


def test_values_are_yaml() -> None:
    given = command_line_settings(
        ["odometry.voxel_size_m=0.4", "ingest.lidar_topic=/a/b", "denoise.ego=true"]
    )
    assert given == {
        "odometry": {"voxel_size_m": 0.4},
        "ingest": {"lidar_topic": "/a/b"},
        "denoise": {"ego": True},
    }


@pytest.mark.parametrize("text", ["odometry", "odometry.x", "odometry=3", ".x=1", "a.=1", "=", "a.b=[1"])
def test_malformed_assignment_is_named(text: str) -> None:
    with pytest.raises(UsageError, match="--set"):
        command_line_settings([text])


def test_later_layers_win_field_by_field() -> None:
    assert merged({"a": {"x": 1, "y": 2}}, {"a": {"x": 3}, "b": {"z": 4}}) == {
        "a": {"x": 3, "y": 2},
        "b": {"z": 4},
    }


def test_project_file(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert project_settings(None) == {}
    (tmp_path / "scanloom.yaml").write_text("odometry:\n  voxel_size_m: 0.4\n")
    assert project_settings(None) == {"odometry": {"voxel_size_m": 0.4}}
    (tmp_path / "scanloom.yaml").write_text("odometry: 3\n")
    with pytest.raises(UsageError, match="mapping of stages"):
        project_settings(None)
    with pytest.raises(UsageError, match=r"other\.yaml"):
        project_settings(tmp_path / "other.yaml")
