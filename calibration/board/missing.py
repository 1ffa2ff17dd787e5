"""Explains to an operator why no board was found in a picture."""

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
from rig.messages.message import Message, compose


def explain(grey: UInt8[np.ndarray, "h w"], board: Board) -> Message | None:
    """Explains why ``detect`` finds no board in a picture that does show a pattern; None if no pattern is
    recognised."""
    inverse = replace(board, inverted=not board.inverted)
    mirrored = detect(np.ascontiguousarray(grey[:, ::-1]), board) is not None
    inverted = detect(grey, inverse) is not None
    if mirrored and inverted:
        return compose("board-mirrored-or-inverted", setting=_toml(inverse))
    if mirrored:
        return compose("board-mirrored")
    if inverted:
        return compose("board-inverted", setting=_toml(inverse))
    picture = 255 - grey if board.inverted else grey
    return _explain_charuco(picture, board) if board.kind == "charuco" else _explain_checkerboard(picture, board)


def _toml(board: Board) -> str:
    return f"inverted = {str(board.inverted).lower()}"


def _size(board: Board) -> str:
    return f"{board.columns} x {board.rows}"


def _explain_checkerboard(grey: np.ndarray, board: Board) -> Message | None:
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
            return compose("board-of-other-size", shown=_size(other), said=_size(board))
    return None


def _explain_charuco(grey: np.ndarray, board: Board) -> Message | None:
    """What the markers in a picture say of the board, once it was not found by them."""
    markers = find_markers(grey, board.dictionary)
    mirrored = find_markers(np.ascontiguousarray(grey[:, ::-1]), board.dictionary)
    if len(mirrored) > len(markers) + 2:
        return compose("board-mirrored")
    inverse = find_markers(255 - grey, board.dictionary)
    if len(inverse) > len(markers) + 2:
        return compose("board-inverted", setting=_toml(replace(board, inverted=not board.inverted)))
    if len(markers) < MARKERS_LEAST:
        other = other_dictionary([grey], board.dictionary)
        if other is None:
            return None
        return compose("board-of-other-dictionary", shown=other, said=board.dictionary)
    return explain_markers([markers], board)


def explain_markers(pictures: Sequence[Markers], board: Board) -> Message | None:
    """Explains how the board in the pictures differs from ``board``, from the markers that they show; None if it does
    not differ."""
    layout = find_layout(pictures, board)
    if layout is None:
        if any(map(is_april_grid, pictures)):
            return compose("board-april-grid")
        return compose("board-markers-disordered")
    if layout.columns != board.columns:
        last = max(max(markers) for markers in pictures if markers) - layout.first_marker + 1
        rows = -(-2 * last // layout.columns)
        return compose("board-of-other-columns", columns=layout.columns, rows=rows, said=_size(board))
    if abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
        return compose("board-marker-ratio", ratio=layout.ratio, said=board.marker_ratio)
    beyond = max(max(markers) for markers in pictures if markers) - layout.first_marker
    if beyond >= board.marker_count:
        return compose("board-marker-beyond", marker=beyond, size=_size(board), held=board.marker_count)
    return None
