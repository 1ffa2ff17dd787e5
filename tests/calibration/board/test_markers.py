"""What the markers of a board tell, drawn flat under a homography: pattern, first number, squares, marker's side."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration.board.board import Board
from calibration.board.detection import (
    WrongBoard,
    board_of,
    detect_folder,
    explain,
    explain_markers,
    find_layout,
    find_markers,
    is_april_grid,
)
from rig.messages.message import texts_of

TOLD = Board("charuco", 8, 6, 25.0, 0.75, "DICT_4X4_50")


def picture(board: Board, turn: int = 0, *, flipped: bool = False) -> np.ndarray:
    """The board before a grey wall, in perspective."""
    scale = 40
    size = (board.columns * scale, board.rows * scale)
    flat = board.opencv().generateImage(size, marginSize=0, borderBits=1)
    flat = np.pad(flat, scale // 2, constant_values=255)
    height, width = flat.shape
    rng = np.random.default_rng(turn)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + rng.uniform(-18, 18, (4, 2)) + (60, 50)
    way = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    seen = cv2.warpPerspective(flat, way, (width + 120, height + 100), flags=cv2.INTER_AREA, borderValue=110)
    seen = cv2.GaussianBlur(seen, (0, 0), 0.7)
    return np.ascontiguousarray(seen[:, ::-1]) if flipped else seen


def markers(board: Board, configured: Board = TOLD) -> list[dict[int, np.ndarray]]:
    return [find_markers(picture(board, turn), configured.dictionary) for turn in range(3)]


@pytest.mark.parametrize("printed", [
    pytest.param(TOLD, id="as described"),
    pytest.param(replace(TOLD, legacy=True), id="first square white"),
    pytest.param(replace(TOLD, first_marker=10), id="second of a pair"),
    pytest.param(replace(TOLD, first_marker=4), id="a row later"),
    pytest.param(replace(TOLD, legacy=True, first_marker=5), id="both"),
])  # fmt: skip
def test_the_pattern_that_was_printed_is_found(printed: Board) -> None:
    layout = find_layout(markers(printed), TOLD)
    assert layout is not None
    assert board_of(layout, TOLD) == printed
    assert layout.ratio == pytest.approx(0.75, abs=0.04)


@pytest.mark.parametrize(("printed", "words"), [
    pytest.param(replace(TOLD, columns=7), "7 squares in a row and 6 rows or more, board.toml says 8", id="columns"),
    pytest.param(replace(TOLD, columns=6, rows=8), "6 squares in a row and 8 rows or more", id="turned"),
    pytest.param(replace(TOLD, marker_ratio=0.6), "board.toml has 0.75: correct marker_ratio", id="ratio"),
    pytest.param(replace(TOLD, dictionary="DICT_5X5_50"), "are from DICT_5X5_50", id="dictionary"),
    pytest.param(replace(TOLD, dictionary="DICT_4X4_250", first_marker=60, rows=5), "are from DICT_4X4_100", id="size"),
])  # fmt: skip
def test_the_cause_is_named(printed: Board, words: str) -> None:
    assert words in str(explain(picture(printed), TOLD))


def test_what_passes_for_a_marker_beside_the_board_adds_no_rows() -> None:
    shown = markers(replace(TOLD, columns=7))
    shown[0][617] = shown[0][0] + 300.0
    assert "7 squares in a row and 6 rows or more" in str(explain_markers(shown, TOLD))


def test_mirrored_and_inverted_pictures_are_named_whatever_the_pattern() -> None:
    for printed in (TOLD, replace(TOLD, legacy=True)):
        assert "mirrored" in str(explain(picture(printed, flipped=True), TOLD))
        assert re.search("colours are inverted.*set inverted = true", str(explain(255 - picture(printed), TOLD)))


def test_kalibrs_grid_is_told_from_a_charuco_board() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    grid = np.full((700, 840), 255, np.uint8)
    for number in range(30):
        row, column = 4 - number // 6, number % 6  # Kalibr counts rows upwards
        top, left = 40 + 125 * row, 40 + 125 * column
        grid[top : top + 96, left : left + 96] = cv2.aruco.generateImageMarker(dictionary, number, 96)
    found = find_markers(cv2.GaussianBlur(grid, (0, 0), 0.7), "DICT_APRILTAG_36h11")
    assert is_april_grid(found)
    assert "AprilGrid" in str(explain(grid, replace(TOLD, dictionary="DICT_APRILTAG_36h11")))
    assert not is_april_grid(markers(TOLD)[0])


def written(folder: Path, board: Board) -> Path:
    for turn in range(3):
        for camera in ("left", "right"):
            (folder / camera).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / camera / f"{turn}.png"), picture(board, turn))
    return folder


def test_a_legacy_board_is_detected_and_told(tmp_path: Path) -> None:
    found = detect_folder(written(tmp_path, replace(TOLD, legacy=True)), TOLD)
    assert len(found.views) == 6
    assert found.board.legacy
    assert texts_of(found.remarks) == ["the board was found with legacy = true: say so in board.toml"]


def test_a_wrong_width_of_markers_is_said_once_and_a_charuco_board_called_a_checkerboard_named(tmp_path: Path) -> None:
    with pytest.raises(WrongBoard, match="correct marker_ratio") as refused:
        detect_folder(written(tmp_path, TOLD), replace(TOLD, marker_ratio=0.6))
    assert str(refused.value).count("marker_ratio") == 1
    checkerboard = Board("checkerboard", TOLD.columns, TOLD.rows, TOLD.square_mm)
    with pytest.raises(WrongBoard, match=r'squares hold markers .*write kind = "charuco"'):
        detect_folder(written(tmp_path, TOLD), checkerboard)
