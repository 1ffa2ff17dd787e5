"""Finds out which board the markers in pictures belong to, if the described one is not found.

A ChArUco board's markers are numbered row by row over its white squares. The description may be wrong in several ways:
OpenCV before 4.6 and calib.io begin an even number of rows with a white square; the second board of a pair begins with
another number; squares may be miscounted, the marker's side mismeasured, the dictionary another. In each case a
homography maps the markers' centres onto another layout, which shows the cause. A marker's side is measured in units of
the squares.

Enters: grey pictures. Leaves: the board that explains most of them, or the reason why none does.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.board.board import SQUARES_LEAST, Board

Markers = Mapping[int, Float[np.ndarray, "4 2"]]  # corners (px) by number

COLUMNS_MOST = 30
MARKERS_LEAST = 5  # of a picture that is measured: a homography is free to meet four
LAYOUT_MISS = 0.12  # of a square, RMS: a right layout has 0.02 and a lens's bend, one shifted by a square 0.3 and more
RATIO_OFF = 0.05  # of the square, between the told and the measured side of markers; 0.01 in sharp pictures


@dataclass(frozen=True, slots=True)
class Layout:
    """Describes how markers are laid out: squares in a row, number of the first marker, and whether the first square is
    white (``legacy``). ``ratio`` is the measured side of a marker divided by that of a square."""

    columns: int
    first_marker: int
    legacy: bool
    ratio: float


def find_markers(grey: UInt8[np.ndarray, "h w"], dictionary: str) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Returns the corners (px) of the markers in a grey picture, by the marker's number. A number that occurs twice is
    left out."""
    return _detected(grey, cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))


def _detected(grey: np.ndarray, dictionary: cv2.aruco.Dictionary) -> dict[int, Float[np.ndarray, "4 2"]]:
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters()).detectMarkers(grey)
    numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
    pairs = zip(numbers, corners, strict=True)
    return {number: np.asarray(c, float).reshape(4, 2) for number, c in pairs if numbers.count(number) == 1}


def find_layout(pictures: Sequence[Markers], board: Board) -> Layout | None:
    """Finds the layout that explains the markers in most pictures, preferring one with as many columns as ``board``;
    None if no layout does."""
    shown = [markers for markers in pictures if len(markers) >= MARKERS_LEAST]
    if not shown:
        return None
    others = [n for n in range(SQUARES_LEAST, COLUMNS_MOST + 1) if n != board.columns]
    for columns in (board.columns, *sorted(others, key=lambda n: abs(n - board.columns))):
        for first in _first_markers(shown, board if columns == board.columns else None):
            for legacy in (board.legacy, not board.legacy):
                layout = _explaining(shown, columns, first, legacy=legacy)
                if layout is not None:
                    return layout
    return None


def _first_markers(shown: Sequence[Markers], board: Board | None) -> list[int]:
    """Returns possible numbers of the first marker: 0 or the board's own if possible, else the least observed one, or a
    lower one if the board has more markers than were observed."""
    least, most = min(min(markers) for markers in shown), max(max(markers) for markers in shown)
    if board is None:
        return [0] if least == 0 else [0, least]
    held = board.columns * board.rows // 2
    possible = [first for first in range(least, -1, -1) if first + held > most]
    likely = [first for first in (board.first_marker, 0) if first in possible]
    return [*dict.fromkeys([*likely, *possible])]


def _explaining(shown: Sequence[Markers], columns: int, first: int, *, legacy: bool) -> Layout | None:
    corners = _layout_corners(columns, legacy=legacy)
    ratios = []
    for markers in shown:
        numbers = np.array([number for number in markers if 0 <= number - first < len(corners)])
        if len(numbers) < max(MARKERS_LEAST, 0.8 * len(markers)):
            continue
        flat, observed = corners[numbers - first], np.array([markers[number] for number in numbers.tolist()])
        miss, ratio = _fit(flat, observed)
        if miss < LAYOUT_MISS:
            ratios.append(ratio)
    if len(ratios) <= 0.5 * len(shown):
        return None
    return Layout(columns, first, legacy, float(np.median(ratios)))


def _layout_corners(columns: int, *, legacy: bool) -> Float[np.ndarray, "m 4 2"]:
    """Returns the markers' corners in squares, as if as wide as a square, for as many rows as any board has."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    rows = min(60, 2 * (len(dictionary.bytesList) // columns))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.999, dictionary)
    board.setLegacyPattern(legacy)
    return np.array([np.asarray(points)[:, :2] for points in board.getObjPoints()], float)


def _fit(flat: Float[np.ndarray, "m 4 2"], observed: Float[np.ndarray, "m 4 2"]) -> tuple[float, float]:
    """Returns how far (squares, RMS) centres of markers miss their layout, and a marker's measured side (squares)."""
    homography, _ = cv2.findHomography(observed.mean(axis=1), flat.mean(axis=1), 0)
    if homography is None or np.linalg.det(homography) <= 0:
        return np.inf, 0.0
    back = cv2.perspectiveTransform(observed.reshape(-1, 1, 2), homography).reshape(observed.shape)
    miss = float(np.sqrt(((back.mean(axis=1) - flat.mean(axis=1)) ** 2).sum(axis=1).mean()))
    sides = np.linalg.norm(np.roll(back, -1, axis=1) - back, axis=2)
    turned = ((back[:, 1] - back[:, 0]) * (flat[:, 1] - flat[:, 0])).sum(axis=1) > 0  # markers lie as the layout's do
    return (miss if turned.mean() > 0.5 else np.inf), float(np.median(sides))


def other_dictionary(greys: Iterable[UInt8[np.ndarray, "h w"]], dictionary: str) -> str | None:
    """Finds another of OpenCV's dictionaries whose markers a picture shows, the smallest that has them; None if there
    is none."""
    names = sorted((name for name in dir(cv2.aruco) if name.startswith("DICT_") and name != dictionary), key=_size)
    for grey in greys:
        counts = {name: len(find_markers(grey, name)) for name in names}
        best = max(names, key=lambda name: counts[name])
        if counts[best] >= MARKERS_LEAST:
            return best
    return None


def _size(name: str) -> int:
    return len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)


def is_april_grid(markers: Markers) -> bool:
    """Tells whether there is a marker in every cell of a grid, numbered row by row, as on Kalibr's AprilGrid."""
    if len(markers) < MARKERS_LEAST:
        return False
    numbers = np.array(sorted(markers))
    observed = np.array([markers[number].mean(axis=0) for number in numbers.tolist()])
    for columns in range(2, COLUMNS_MOST):
        for turn in (1.0, -1.0):  # Kalibr counts rows upwards
            flat = np.stack([numbers % columns, turn * (numbers // columns)], axis=1).astype(float)
            if np.linalg.matrix_rank(flat - flat.mean(axis=0)) < 2:
                continue
            homography, _ = cv2.findHomography(observed, flat, 0)
            if homography is not None:
                back = cv2.perspectiveTransform(observed[:, None], homography)[:, 0]
                if float(np.sqrt(((back - flat) ** 2).sum(axis=1).mean())) < LAYOUT_MISS:
                    return True
    return False


def board_of(layout: Layout, board: Board) -> Board | None:
    """Returns ``board`` with the first marker number and the colour of the first square that ``layout`` has; None if
    the layout differs in the number of squares or in the size of markers."""
    if layout.columns != board.columns or abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
        return None
    return replace(board, legacy=layout.legacy, first_marker=layout.first_marker)
