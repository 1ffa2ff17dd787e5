"""Why no board was found in a picture, as an operator would say it."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from calibration.board.board import SQUARES_LEAST, Board
from calibration.board.corners import classic_corners, detect, in_board_order, pattern_continues


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
    detector = cv2.aruco.ArucoDetector(board.opencv().getDictionary(), cv2.aruco.DetectorParameters())
    _, ids, _ = detector.detectMarkers(grey)
    if ids is None or len(ids) < 3:
        return None
    held = board.columns * board.rows // 2
    if int(ids.max()) >= held:
        squares = f"{board.columns} x {board.rows} squares"
        return f"it shows marker {int(ids.max())}, but {squares} hold only {held}: correct columns and rows"
    return "it shows markers of the dictionary in another order: correct columns and rows in board.toml"
