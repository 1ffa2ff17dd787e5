"""Why no board was found in a picture, as an operator would say it."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from calibration.board.board import SQUARES_LEAST, Board
from calibration.board.corners import classic_corners, detect, in_board_order, pattern_continues
from calibration.board.markers import (
    MARKERS_LEAST,
    RATIO_OFF,
    Markers,
    find_layout,
    find_markers,
    is_april_grid,
    other_dictionary,
)


def explain(grey: UInt8[np.ndarray, "h w"], board: Board) -> str | None:
    """Why ``detect`` finds nothing in a picture that does show a pattern; None if it shows none that is recognised."""
    inverse = replace(board, inverted=not board.inverted)
    mirrored = detect(np.ascontiguousarray(grey[:, ::-1]), board) is not None
    inverted = detect(grey, inverse) is not None
    if mirrored and inverted:
        return f"its colours are those of a mirrored or an inverted board: turn mirroring off, or set {_toml(inverse)}"
    if mirrored:
        return "the board or the picture is mirrored: turn off mirroring in the camera or its software, or print again"
    if inverted:
        return f"the colours are inverted: set {_toml(inverse)} in board.toml"
    picture = 255 - grey if board.inverted else grey
    return _explain_charuco(picture, board) if board.kind == "charuco" else _explain_checkerboard(picture, board)


def _toml(board: Board) -> str:
    return f"inverted = {str(board.inverted).lower()}"


def _explain_checkerboard(grey: np.ndarray, board: Board) -> str | None:
    near = [
        replace(board, columns=board.columns + more, rows=board.rows + higher)
        for more in range(-2, 3)
        for higher in range(-2, 3)
        if (more or higher) and min(board.columns + more, board.rows + higher) >= SQUARES_LEAST
    ]
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # no precision is needed
    for other in sorted(near, key=lambda b: abs(b.columns - board.columns) + abs(b.rows - board.rows)):
        corners = classic_corners(small, other)
        if corners is not None and not pattern_continues(small, in_board_order(small, corners.astype(float), other)):
            said = f"{board.columns} x {board.rows}"
            return f"it shows {other.columns} x {other.rows} squares, board.toml says {said}: correct columns and rows"
    return None


def _explain_charuco(grey: np.ndarray, board: Board) -> str | None:
    """What the markers in a picture say of the board, once it was not found by them."""
    markers = find_markers(grey, board.dictionary)
    mirrored = find_markers(np.ascontiguousarray(grey[:, ::-1]), board.dictionary)
    if len(mirrored) > len(markers) + 2:
        return "the board or the picture is mirrored: turn off mirroring in the camera or its software, or print again"
    inverse = find_markers(255 - grey, board.dictionary)
    if len(inverse) > len(markers) + 2:
        return f"the colours are inverted: set {_toml(replace(board, inverted=not board.inverted))} in board.toml"
    if len(markers) < MARKERS_LEAST:
        other = other_dictionary([grey], board.dictionary)
        if other is None:
            return None
        return f"its markers are of {other}, board.toml says {board.dictionary}: correct dictionary"
    return explain_markers([markers], board)


def explain_markers(pictures: Sequence[Markers], board: Board) -> str | None:
    """What is wrong with the described board by the markers that pictures show; None where nothing is."""
    layout = find_layout(pictures, board)
    if layout is None:
        if any(map(is_april_grid, pictures)):
            return "its markers stand in every cell, as on an AprilGrid, which is not read: print a board of ours"
        return "it shows markers of the dictionary in an order that no ChArUco board has: is board.toml of this board?"
    if layout.columns != board.columns:
        last = max(max(markers) for markers in pictures if markers) - layout.first_marker + 1
        rows = -(-2 * last // layout.columns)
        said = f"board.toml says {board.columns} x {board.rows}"
        return f"it shows {layout.columns} squares in a row and {rows} rows or more, {said}: correct columns and rows"
    if abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
        return (
            f"its markers are {layout.ratio:.2f} times as wide as its squares, board.toml says "
            f"{board.marker_ratio:g}: correct marker_ratio"
        )
    beyond = max(max(markers) for markers in pictures if markers) - layout.first_marker
    if beyond >= board.marker_count:
        said = f"{board.columns} x {board.rows} squares"
        return f"it shows marker {beyond}, but {said} hold only {board.marker_count}: correct rows"
    return None
