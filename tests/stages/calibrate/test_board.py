from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scanloom.schemas.errors import InvalidInput
from scanloom.stages.calibrate.board import Board, parse_board, read_board

TEXT = b"inner_corners: [7, 5]\nsquare_m: 0.095\nboard_m: [0.850, 0.610]\noffset_m: [0.002, 0.0]\n"


def test_corners_and_outline_in_the_frame_of_the_pattern() -> None:
    board = parse_board(TEXT, "board.yaml")
    corners, outline = board.corners_m(), board.outline_m()
    assert corners.shape == (35, 3)
    assert corners[0] == pytest.approx([-0.285, -0.19, 0])
    assert corners[1] - corners[0] == pytest.approx([0, 0.095, 0])
    assert corners[5] - corners[0] == pytest.approx([0.095, 0, 0])
    assert corners.mean(axis=0) == pytest.approx([0, 0, 0])
    assert outline.mean(axis=0) == pytest.approx([0.002, 0, 0])
    assert np.ptp(outline, axis=0) == pytest.approx([0.85, 0.61, 0])
    around = np.cross(outline[1] - outline[0], outline[2] - outline[1])
    assert around[2] > 0
    assert board.squares == (8, 6)


def test_turns_that_look_alike() -> None:
    assert parse_board(TEXT, "b").ambiguity == 2
    assert Board(inner_corners=(5, 5), square_m=0.1, board_m=(0.6, 0.6)).ambiguity == 4


@pytest.mark.parametrize(
    "text, names",
    [
        (b"square_m: 0.095\nboard_m: [0.85, 0.61]\n", "inner_corners: Field required"),
        (TEXT + b"colour: red\n", "colour"),
        (TEXT.replace(b"0.850", b"0.5"), "7 inner corners of 0.095 m do not fit on 0.5 m"),
        (TEXT.replace(b"0.850", b".nan"), "nan"),
        (TEXT.replace(b"0.850", b"-1"), "-1"),
        (TEXT.replace(b"[7, 5]", b"[7, 1]"), "inner_corners"),
        (TEXT + b"charuco: {dictionary: DICT_5X5_100, marker_m: 0.095}\n", "charuco.marker_m"),
        (b"[1", "no YAML"),
        (b"\xff\xfe\x00", "no YAML"),
        (b"7", "no list of keys"),
        (b"x" * 70_000, "too long"),
    ],
)
def test_what_is_no_board_is_said(text: bytes, names: str) -> None:
    with pytest.raises(InvalidInput, match=r"board\.yaml") as refused:
        parse_board(text, "board.yaml")
    assert names in str(refused.value)
    assert refused.value.next_step


def test_a_pattern_may_fill_its_plate_but_not_more() -> None:
    Board(inner_corners=(3, 3), square_m=0.1, board_m=(0.2, 0.2))
    with pytest.raises(ValueError, match="do not fit"):
        Board(inner_corners=(3, 3), square_m=0.1, board_m=(0.2, 0.2), offset_m=(0.001, 0.0))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"nowhere\.yaml"):
        read_board(tmp_path / "nowhere.yaml")
    path = tmp_path / "board.yaml"
    path.write_bytes(TEXT)
    assert read_board(path) == parse_board(TEXT, "elsewhere")
