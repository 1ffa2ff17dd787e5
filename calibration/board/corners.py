"""Finds the numbers and sub-pixel positions of a board's corners in one grey picture.

OpenCV's ``findChessboardCornersSB`` finds checkerboards (A. Duda, U. Frese, "Accurate Detection and Localization of
Checkerboard Corners for Calibration", BMVC 2018). If OpenCV's exhaustive search also fails, the older detector and
``cornerSubPix`` are used. ``CharucoDetector`` finds ChArUco boards. The corners in a picture must be the image of a
flat grid seen from its front. A checkerboard must have the described size; its corners are ordered so that the grid is
right-handed and agrees with the colours. If a rotation leaves the colours unchanged (``Board.turns``), the pose graph
chooses the order later. The option CALIB_CB_LARGER is not used: on real pictures it adds rows that do not exist.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from calibration.board.board import Board

Corners = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]  # numbers of the board's corners (rising), pixels

CORNERS_LEAST = 6  # a pose of a plane from fewer is loose and cannot be checked
# A lens bends the image of the grid by less than this, in squares; a misread grid is off by a whole square.
BENT_MOST = 0.35
SB = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Holds the numbers ``ids`` and the pixels of the board's corners in one picture. ``rise_px`` measures the blur as
    the width (px) of an edge from 10 to 90 % of its contrast."""

    ids: Int[np.ndarray, " n"]
    corners: Float[np.ndarray, "n 2"]
    rise_px: float


def detect(grey: UInt8[np.ndarray, "h w"], board: Board) -> Found | None:
    """Returns the sub-pixel corners of the board in one grey picture, in the board's order, or None."""
    picture = 255 - grey if board.inverted else grey
    corners = (_charuco if board.kind == "charuco" else _checkerboard)(picture, board)
    if corners is None or len(corners[0]) < CORNERS_LEAST or not is_flat_grid(board, *corners):
        return None
    return Found(*corners, measure_rise(picture, board, corners))


def is_flat_grid(board: Board, ids: Int[np.ndarray, " n"], corners: Float[np.ndarray, "n 2"]) -> bool:
    """Returns whether ``corners`` (px) are, up to lens distortion, the image of the board's front."""
    flat = board.corners()[ids, :2] / board.square_mm
    if np.linalg.matrix_rank(flat - flat.mean(axis=0)) < 2:
        return False
    homography, inverse = _homography(flat, corners), _homography(corners, flat)
    if homography is None or inverse is None:
        return False
    back = cv2.perspectiveTransform(corners[:, None], inverse)[:, 0]
    return bool(np.linalg.det(homography) > 0 and np.abs(back - flat).max() < BENT_MOST)


def measure_rise(grey: UInt8[np.ndarray, "h w"], board: Board, found: Corners) -> float:
    """Computes the width (px) of the board's edges, from 10 to 90 % of their contrast, in the blurrier of the board's
    two directions. Returns infinity if every edge is wider than the half square or the marker's border beside it."""
    ids, corners = found
    flat = board.corners()[ids, :2] / board.square_mm
    homography = _homography(flat, corners)
    reach = 0.45 if board.kind == "checkerboard" else 0.45 * (1.0 - board.marker_ratio)
    columns = board.grid[0]
    widths = []
    for step, across in ((1, (0.0, 1.0)), (columns, (1.0, 0.0))):
        starts = np.flatnonzero(np.isin(ids + step, ids) & ((step > 1) | ((ids + 1) % columns != 0)))
        if len(starts) and homography is not None:
            middles = (flat[starts] + flat[np.searchsorted(ids, ids[starts] + step)]) / 2
            widths.append(_edge_width(grey, homography, middles, np.array(across) * reach))
    return max(widths, default=np.inf)


def _edge_width(grey: np.ndarray, homography: np.ndarray, middles: np.ndarray, reach: np.ndarray) -> float:
    """Returns the median width of edges through ``middles`` (board frame, in squares), sampled up to ``reach``."""
    steps, along = np.linspace(-1.0, 1.0, 61), 0.1 * (reach[::-1] > 0)
    # Three lines beside each other, averaged: noise must not pass for blur.
    points = middles[:, None, None] + np.array([-1, 0, 1])[:, None, None] * along + steps[:, None] * reach
    pixels = cv2.perspectiveTransform(points.reshape(-1, 1, 2), homography).reshape(points.shape).astype(np.float32)
    flattened = pixels.reshape(-1, len(steps), 2)
    samples = cv2.remap(grey, flattened[..., 0], flattened[..., 1], cv2.INTER_LINEAR)
    profiles = samples.reshape(points.shape[:3]).mean(axis=1, dtype=float)
    low, high = profiles[:, :6].mean(axis=1, keepdims=True), profiles[:, -6:].mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = (profiles - low) / (high - low)
    length = np.linalg.norm(pixels[:, 1, -1] - pixels[:, 1, 0], axis=1)
    widths = ((height > 0.1) & (height < 0.9)).mean(axis=1) * length
    widths[np.abs(high - low)[:, 0] < 10.0] = np.inf
    return float(np.median(widths))


def _homography(source: np.ndarray, target: np.ndarray) -> Float[np.ndarray, "3 3"] | None:
    return cv2.findHomography(source, target, 0)[0]


def _checkerboard(grey: np.ndarray, board: Board) -> Corners | None:
    exhaustive = partial(_sector_based, flags=SB | cv2.CALIB_CB_EXHAUSTIVE)
    for finder in (_sector_based, exhaustive, classic_corners):
        corners = finder(grey, board)
        if corners is None:
            continue
        grid = in_board_order(grey, corners.astype(float), board)
        numbers, pixels = np.arange(board.corner_count), grid.reshape(-1, 2)
        if is_flat_grid(board, numbers, pixels):
            mirrored = board.is_chiral and _contrast(grey, grid) < 0  # or printed in inverted colours
            return None if mirrored or pattern_continues(grey, grid) else (numbers, pixels)
    return None


def in_board_order(grey: np.ndarray, corners: np.ndarray, board: Board) -> Float[np.ndarray, "rows columns 2"]:
    """Returns the corners (px) as a grid of rows and columns, turned so that the grid is right-handed and agrees with
    the board's colours."""
    columns, rows = board.grid
    grid = corners.reshape(rows, columns, 2)
    across, down = (grid[:, -1] - grid[:, 0]).mean(axis=0), (grid[-1] - grid[0]).mean(axis=0)
    if np.linalg.det(np.stack([across, down])) < 0:
        grid = grid[:, ::-1]
    if _contrast(grey, grid) < 0:
        # A half turn restores the colours where columns + rows is odd, a quarter turn on a square board with even
        # sides; elsewhere neither does harm.
        grid = np.rot90(grid) if columns == rows else grid[::-1, ::-1]
    return np.ascontiguousarray(grid)


def _contrast(grey: np.ndarray, grid: Float[np.ndarray, "rows columns 2"]) -> float:
    """Returns the mean grey value of the board's white squares minus the mean of its black squares."""
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    row, column = np.indices(middles.shape[:2])
    black = (row + column) % 2 == 0  # the square between the first four inner corners is (1, 1): black
    values = _values(grey, middles)
    return float(values[~black].mean() - values[black].mean())


def pattern_continues(grey: np.ndarray, grid: Float[np.ndarray, "rows columns 2"]) -> bool:
    """Returns whether the squares continue outside the grid, so that the corners belong to a larger board."""
    inside = abs(_contrast(grey, grid))
    rows, columns = grid.shape[:2]
    flat = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    homography = _homography(flat, grid.reshape(-1, 2))
    if homography is None:
        return False
    # Inner corners are at 0 .. n - 1, the outline at -1 and n, the middles of squares outside it at -1.5 and n + 0.5.
    across, down = np.arange(columns - 1) + 0.5, np.arange(rows - 1) + 0.5
    lines = [np.stack([across, np.full_like(across, y)], axis=1) for y in (-1.5, rows + 0.5)]
    lines += [np.stack([np.full_like(down, x), down], axis=1) for x in (-1.5, columns + 0.5)]
    for line in lines:
        pixels = cv2.perspectiveTransform(line[:, None], homography)[:, 0]
        if (pixels < 0).any() or (pixels > np.array(grey.shape[::-1]) - 1).any():
            continue
        values = _values(grey, pixels)
        if len(line) > 1 and abs(values[::2].mean() - values[1::2].mean()) > 0.6 * inside:
            return True
    return False


def _values(grey: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    at = np.clip(np.rint(pixels).astype(int), 0, np.array(grey.shape[::-1]) - 1)
    return grey[at[..., 1], at[..., 0]].astype(float)


def _sector_based(grey: np.ndarray, board: Board, flags: int = SB) -> np.ndarray | None:
    ok, corners = cv2.findChessboardCornersSB(grey, board.grid, flags=flags)
    return corners.reshape(-1, 2) if ok else None


def classic_corners(grey: np.ndarray, board: Board) -> np.ndarray | None:
    """Returns the corners (px, row by row) from OpenCV's adaptive threshold detector, or None if any is missing."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    ok, corners = cv2.findChessboardCorners(grey, board.grid, flags=flags)
    return _refine(grey, corners.reshape(-1, 2), 0.35, board) if ok else None


def _refine(grey: np.ndarray, corners: np.ndarray, share: float, board: Board) -> np.ndarray:
    """Refines corners (px) with ``cornerSubPix``; the window is ``share`` of a square's side in the image."""
    spread = np.sqrt(abs(np.linalg.det(np.cov(corners.T))))  # of a uniform grid: (n sides)^2 / 12 in each direction
    side = np.sqrt(12.0 * spread / board.corner_count)
    window = int(np.clip(share * side, 2, 15))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = np.array(corners, dtype=np.float32).reshape(-1, 1, 2)
    return cv2.cornerSubPix(grey, start, (window, window), (-1, -1), criteria).reshape(-1, 2)


def _charuco(grey: np.ndarray, board: Board) -> Corners | None:
    detector = cv2.aruco.CharucoDetector(board.opencv())
    corners, ids, _, _ = detector.detectBoard(grey)
    if ids is None or len(ids) < 4:
        return None
    order = np.argsort(ids.ravel())
    return ids.ravel()[order].astype(int), np.asarray(corners, dtype=float).reshape(-1, 2)[order]
