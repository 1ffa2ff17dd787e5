"""board.toml and the printed sheet: what is drawn, read back from the PDF at its true scale, is the board described."""

import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.board.board import Board, read_board, write_board, write_board_pdf
from calibration.board.corners import detect
from rig.errors import InputError

BOARDS = [
    Board("checkerboard", 9, 6, 25.0),
    Board("checkerboard", 5, 8, 30.0, inverted=True),
    Board("charuco", 7, 5, 30.0, dictionary="DICT_5X5_100"),
    Board("charuco", 4, 5, 54.0, inverted=True, measured_width_mm=215.5),
]
MM_PER_POINT = 25.4 / 72.0


def rasterise(path: Path, pixels_per_mm: float) -> np.ndarray:
    """The page as grey pixels, from the PDF's filled rectangles alone: an oracle of 20 lines that knows only the PDF
    operators ``g`` (grey), ``re`` (rectangle) and the page's size."""
    data = path.read_bytes()
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    assert box is not None
    width, height = (float(side) * MM_PER_POINT for side in box.groups())
    page = np.full((round(height * pixels_per_mm), round(width * pixels_per_mm)), 255, np.uint8)
    stream = re.search(rb"stream\n(.*?)\nendstream", data, re.S)
    assert stream is not None
    grey = 0
    for line in zlib.decompress(stream[1]).decode("latin-1").splitlines():
        if paint := re.match(r"([\d.]+)(?: [\d.]+ [\d.]+)? (?:g|rg)$", line):
            grey = round(255 * float(paint[1]))
        if box := re.match(r"([-\d.]+) ([-\d.]+) ([-\d.]+) ([-\d.]+) re f$", line):
            x, y, w, h = (float(value) * MM_PER_POINT for value in box.groups())
            ys = sorted(round((height - edge) * pixels_per_mm) for edge in (y, y + h))
            xs = sorted(round(edge * pixels_per_mm) for edge in (x, x + w))
            page[ys[0] : ys[1], xs[0] : xs[1]] = grey
    return page


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: f"{b.kind}-{b.columns}x{b.rows}")
def test_the_printed_sheet_is_the_board_at_true_scale(board: Board, tmp_path: Path) -> None:
    write_board_pdf(board, tmp_path / "board.pdf")
    scale = 4.0
    page = rasterise(tmp_path / "board.pdf", scale)
    found = detect(page, board)
    assert found is not None
    assert len(found.ids) == board.corner_count
    flat = board.corners()[found.ids, :2]
    # Rasterised edges lie within half a pixel, and so do corners: 0.13 mm over the whole board.
    offset = found.corners / scale - flat
    assert np.abs(offset - offset.mean(axis=0)).max() < 0.13


def test_the_ruler_is_100_mm_long_and_the_same_board_gives_the_same_bytes(tmp_path: Path) -> None:
    write_board_pdf(BOARDS[0], tmp_path / "board.pdf")
    page = rasterise(tmp_path / "board.pdf", 20.0)
    foot = page[-15 * 20 : -9 * 20]
    dark = np.flatnonzero((foot < 128).any(axis=0))
    assert (dark[-1] - dark[0]) / 20.0 == pytest.approx(100.1, abs=0.1)  # ticks are 0.1 mm wide
    write_board_pdf(BOARDS[0], tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "board.pdf").read_bytes()


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: f"{b.kind}-{b.columns}x{b.rows}")
def test_what_is_written_is_read_back(board: Board, tmp_path: Path) -> None:
    write_board(board, tmp_path / "board.toml")
    (tmp_path / "board.toml").write_text((tmp_path / "board.toml").read_text(), encoding="utf-16")
    assert read_board(tmp_path / "board.toml") == board


def test_every_fault_of_a_board_is_named(tmp_path: Path) -> None:
    path = tmp_path / "board.toml"
    path.write_text('kind = "circles"\ncolumns = 1\nrows = true\nsquare_mm = nan\ncolour = 3\n')
    with pytest.raises(InputError) as error:
        read_board(path)
    for key in ("kind", "columns", "rows", "square_mm", "colour"):
        assert any(key in fault.text for fault in error.value.faults), key
    path.with_suffix(".pdf").write_bytes(b"%PDF-1.3 \xff")
    with pytest.raises(InputError, match=r"is no board\.toml.*eigenhead board"):
        read_board(path.with_suffix(".pdf"))
    write_board(replace(BOARDS[2], columns=20, rows=20), path)
    with pytest.raises(InputError, match="holds 100 markers; the board needs 200"):
        read_board(path)


@pytest.mark.parametrize(
    ("columns", "rows", "turns", "chiral"),
    [(9, 6, 1, False), (8, 6, 2, True), (7, 5, 2, False), (6, 6, 2, False), (7, 7, 4, False)],
)
def test_which_turns_a_checkerboard_hides(columns: int, rows: int, turns: int, chiral: bool) -> None:
    board = Board("checkerboard", columns, rows, 25.0)
    assert len(board.turns()) == turns
    assert board.is_chiral is chiral
    squares = board.squares()
    # Independent count: the rotations, and the reflections, that leave the pattern of colours as it is.
    same = sum(np.array_equal(np.rot90(squares, k), squares) for k in range(4))
    mirrored = any(np.array_equal(np.rot90(squares[:, ::-1], k), squares) for k in range(4))
    assert same == turns
    assert mirrored is not chiral
