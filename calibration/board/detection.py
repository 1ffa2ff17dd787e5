"""Finds the board in many pictures, in parallel, and caches the results by the pictures' content. If the described
board is not found, the markers show which board is in the pictures.

A ChArUco board's markers are numbered row by row over its white squares. The description of the board may be wrong in
several ways. OpenCV before 4.6 and calib.io begin a board of an even number of rows with a white square. The second
ChArUco board of a pair begins with another marker number. The user may have miscounted squares, mismeasured the
marker's side, or named the wrong dictionary. Each wrong description implies another layout of the markers. The layout
to which a homography maps the markers' centres reveals the fault.
"""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.board.board import SQUARES_LEAST, Board
from calibration.board.corners import Found, classic_corners, detect, in_board_order, pattern_continues
from calibration.board.picture_files import filed_by_shot, list_pictures
from rig.errors import EigenheadError, InputError
from rig.files import write_atomically
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress

VERSION = 2  # of the detector: part of the cache's key
EXPLAINED = 4  # pictures of a blind camera that are looked at twice
MEASURED = 24  # pictures whose markers are measured where the board is not found as it was described ...
SHARP_PX = 4.0  # of an edge: 1.5 in focus; the edges of markers beside a square's corner are 5 px and more apart
TRIED = 6  # pictures in which the markers of all dictionaries are looked for
FEW_FOUND = 0.2  # ... that is in less than this share of them
Markers = Mapping[int, Float[np.ndarray, "4 2"]]  # corners (px) by number

COLUMNS_MOST = 30
MARKERS_LEAST = 5  # of a picture that is measured: a homography is free to meet four
LAYOUT_MISS = 0.12  # of a square, RMS: a right layout has 0.02 and a lens's bend, one shifted by a square 0.3 and more
RATIO_OFF = 0.05  # of the square, between the told and the measured side of markers; 0.01 in sharp pictures


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Holds the corners of the board that one camera saw in one shot."""

    camera: str
    shot: str
    found: Found


@dataclass(frozen=True, slots=True)
class PictureNote:
    """Holds the reason why the board was not found in a picture of a camera."""

    camera: str
    picture: str
    reason: Message

    def message(self) -> Message:
        """Returns a message that names the picture and the reason."""
        return compose("located", where=f"{self.camera}/{self.picture}", fault=self.reason)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Holds the board's corners in all pictures.

    Attributes:
        board: the board, corrected if the markers contradict its description.
        sizes: width and height of each camera's pictures, px.
        shots: names of the shots.
        views: the corners that each camera saw in each shot.
        notes: reasons why some cameras never see the board.
        remarks: differences between the board and its description.
    """

    board: Board
    sizes: dict[str, tuple[int, int]]
    shots: tuple[str, ...]
    views: tuple[View, ...]
    notes: tuple[PictureNote, ...] = ()
    remarks: tuple[Message, ...] = ()

    @property
    def corner_count(self) -> int:
        """Returns the number of corners in all views."""
        return sum(len(view.found.ids) for view in self.views)


class WrongBoard(EigenheadError):
    """Reports that the pictures show a board that differs from its description."""

    def __init__(self, reasons: Iterable[Message]) -> None:
        super().__init__(compose("wrong-board", notes=tuple(reasons)))


def reasons_of(notes: Iterable[PictureNote]) -> list[Message]:
    """Returns one message for each reason, which lists the pictures."""
    pictures: dict[Message, list[str]] = {}
    for note in notes:
        pictures.setdefault(note.reason, []).append(f"{note.camera}/{note.picture}")
    return [compose("located", where=_some_pictures(names), fault=reason) for reason, names in pictures.items()]


def _some_pictures(names: list[str]) -> str | Message:
    if len(names) == 1:
        return names[0]
    if len(names) == 2:
        return compose("both", first=names[0], second=names[1])
    return compose("picture-and-others", picture=names[0], others=len(names) - 1)


def detect_folder(
    folder: Path,
    board: Board,
    *,
    cache: Path | None = None,
    workers: int = 2,
    together: bool = True,
    report: Progress = discard_progress,
) -> Detections:
    """Finds the board in every picture of ``folder``. A ChArUco board is also found if the description has a wrong
    colour of the first square or a wrong first marker number.

    The folder ``cache`` stores results by the pictures' SHA-256. ``together`` requires cameras to share shots. Raises
    InputError for damaged input, and WrongBoard if pictures show only another board.
    """
    pictures = list_pictures(folder, together=together)
    detections = _detect_pictures(folder, pictures, board, cache, workers, report)
    if board.kind == "charuco":
        detections = _with_measured_pattern(folder, pictures, detections, cache, workers, report)
    elif sum(view.found.rise_px < SHARP_PX for view in detections.views) < FEW_FOUND * sum(map(len, pictures.values())):
        _refuse_markers(pictures)
    if detections.notes and not detections.views:
        raise WrongBoard(reasons_of(detections.notes))
    if filed_by_shot(pictures):
        return replace(detections, remarks=(*detections.remarks, compose("board-filed-by-shot")))
    return detections


def _with_measured_pattern(
    folder: Path,
    pictures: dict[str, dict[str, Path]],
    detections: Detections,
    cache: Path | None,
    workers: int,
    report: Progress,
) -> Detections:
    """If the board is not found as described, reads its layout from its markers and detects again. Raises WrongBoard if
    the markers' side differs from the description, because the edges would then seem blurred."""
    board = detections.board
    found_share = len(detections.views) / sum(map(len, pictures.values()))
    greys = _sample(pictures, MEASURED)
    greys = [255 - grey for grey in greys] if board.inverted else greys
    markers = [find_markers(grey, board.dictionary) for grey in greys[: MEASURED if found_share < FEW_FOUND else 4]]
    if found_share >= FEW_FOUND:
        layout = find_layout(markers, board)
        if layout is not None and abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
            raise WrongBoard([explanation] if (explanation := explain_markers(markers, board)) else [])
        return detections
    layout = find_layout(markers, board)
    measured = None if layout is None else board_of(layout, board)
    if measured is None or measured == board:
        return detections
    again = _detect_pictures(folder, pictures, measured, cache, workers, report)
    if len(again.views) <= len(detections.views):
        return detections
    keys = ["legacy = true"] if measured.legacy != board.legacy else []
    keys += [f"first_marker = {measured.first_marker}"] if measured.first_marker != board.first_marker else []
    remark = compose("board-found-with", keys=keys)
    return replace(again, remarks=(remark,))


def _refuse_markers(pictures: dict[str, dict[str, Path]]) -> None:
    """Raises WrongBoard if the pictures show markers though the board is described as a checkerboard. Part of a ChArUco
    board may be detected as a checkerboard, and the markers mistaken for blur."""
    dictionary = other_dictionary(_sample(pictures, TRIED)[:TRIED], "")
    if dictionary is not None:
        raise WrongBoard([compose("board-has-markers", dictionary=dictionary)])


def _sample(pictures: dict[str, dict[str, Path]], count: int) -> list[UInt8[np.ndarray, "_ _"]]:
    """Returns about ``count`` grey pictures, spread over all cameras and shots."""
    paths = [path for shots in pictures.values() for path in shots.values()]
    every = paths[:: max(1, len(paths) // count)]
    return [grey for path in every if (grey := _decode(path.read_bytes())) is not None]


def _detect_pictures(
    folder: Path, pictures: dict[str, dict[str, Path]], board: Board, cache: Path | None, workers: int, report: Progress
) -> Detections:
    """Detects one board in all pictures. Raises InputError on damaged input."""
    tasks = [(camera, shot, path) for camera, shots in pictures.items() for shot, path in shots.items()]
    results: list[tuple[tuple[int, int], Found | None] | Message] = []
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(_detect_file, path, board, cache) for _, _, path in tasks]
        try:
            for done, future in enumerate(futures, start=1):
                results.append(future.result())
                report("detection", done / len(futures))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    faults = [
        compose("of-file", file=f"{c}/{path.name}", fault=result)
        for (c, _, path), result in zip(tasks, results, strict=True)
        if isinstance(result, Message)
    ]
    sizes: dict[str, tuple[int, int]] = {}
    views = []
    for (camera, shot, path), result in zip(tasks, results, strict=True):
        if isinstance(result, Message):
            continue
        size, detection = result
        if sizes.setdefault(camera, size) != size:
            faults.append(
                compose(
                    "pictures-of-two-sizes",
                    picture=f"{camera}/{path.name}",
                    size=f"{size[0]} x {size[1]}",
                    first="{} x {}".format(*sizes[camera]),
                )
            )
        if detection is not None:
            views.append(View(camera, shot, detection))
    if faults:
        raise InputError(folder.name, faults)
    shots = tuple(sorted({shot for _, shot, _ in tasks}))
    notes = _explain_missing(pictures, sizes, views, board)
    return Detections(board, sizes, shots, tuple(views), tuple(notes))


def _detect_file(path: Path, board: Board, cache: Path | None) -> tuple[tuple[int, int], Found | None] | Message:
    """Returns the picture's width and height (px) and its corners, or a message about the file's fault."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return compose("no-file-read", reason=str(error.strerror or error))
    grey = _decode(data)
    if grey is None:
        return compose("picture-undecodable")
    size = (grey.shape[1], grey.shape[0])
    if cache is None:
        return size, detect(grey, board)
    key = hashlib.sha256(f"{VERSION} {cv2.__version__} {board!r} ".encode() + data).hexdigest()
    cached = cache / f"{key}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, zipfile.BadZipFile):  # absent or damaged: detect again
        return size, _from_cache(cached)
    detection = detect(grey, board)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        **(
            {} if detection is None else {"ids": detection.ids, "corners": detection.corners, "rise": detection.rise_px}
        ),
    )
    write_atomically(cached, buffer.getvalue())
    return size, detection


def _decode(data: bytes) -> UInt8[np.ndarray, "h w"] | None:
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None


def _from_cache(path: Path) -> Found | None:
    with np.load(path) as stored:
        return Found(stored["ids"], stored["corners"], float(stored["rise"])) if "ids" in stored else None


def _explain_missing(
    pictures: dict[str, dict[str, Path]], sizes: dict[str, tuple[int, int]], views: list[View], board: Board
) -> list[PictureNote]:
    """Returns the reasons, where recognised, why some cameras never see the board."""
    notes = []
    cameras_with_board = {view.camera for view in views}
    for camera in (camera for camera in sizes if camera not in cameras_with_board):
        paths = list(pictures[camera].values())
        for path in paths[:: max(1, len(paths) // EXPLAINED)][:EXPLAINED]:
            grey = _decode(path.read_bytes())
            reason = explain(grey, board) if grey is not None else None
            if reason:
                notes.append(PictureNote(camera, path.name, reason))
                break
    return notes


def explain(grey: UInt8[np.ndarray, "h w"], board: Board) -> Message | None:
    """Explains why ``detect`` finds no board in a picture with a pattern; None if no pattern is recognised."""
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
    """Explains from the markers in a picture why the board was not found."""
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
    """Explains from the markers in pictures how the visible board differs from ``board``. Returns None if the visible
    board agrees with ``board``."""
    layout = find_layout(pictures, board)
    if layout is None:
        if any(map(is_april_grid, pictures)):
            return compose("board-april-grid")
        return compose("board-markers-disordered")
    if layout.columns != board.columns:
        rows = -(-2 * layout.markers // layout.columns)
        return compose("board-of-other-columns", columns=layout.columns, rows=rows, said=_size(board))
    if abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
        return compose("board-marker-ratio", ratio=layout.ratio, said=board.marker_ratio)
    if layout.markers > board.marker_count:
        return compose("board-marker-beyond", marker=layout.markers - 1, size=_size(board), held=board.marker_count)
    return None


@dataclass(frozen=True, slots=True)
class Layout:
    """Describes the layout of markers: squares in a row, number of the first marker, and whether the first square is
    white (``legacy``). ``ratio`` is the measured side of a marker divided by a square's side. ``markers`` counts the
    markers up to the last one that fits the layout, because false markers may be detected in the background."""

    columns: int
    first_marker: int
    legacy: bool
    ratio: float
    markers: int


def find_markers(grey: UInt8[np.ndarray, "h w"], dictionary: str) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Returns the corners (px) of the markers in a grey picture by marker number, without numbers that occur twice."""
    return _detected(grey, cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))


def _detected(grey: np.ndarray, dictionary: cv2.aruco.Dictionary) -> dict[int, Float[np.ndarray, "4 2"]]:
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters()).detectMarkers(grey)
    numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
    pairs = zip(numbers, corners, strict=True)
    return {number: np.asarray(c, float).reshape(4, 2) for number, c in pairs if numbers.count(number) == 1}


def find_layout(pictures: Sequence[Markers], board: Board) -> Layout | None:
    """Finds the layout that explains the markers in most pictures, preferably with as many columns as ``board``.
    Returns None if no layout fits."""
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
    """Returns possible numbers of the board's first marker: 0, the number in the description, the least observed
    number, or a lower number if the board has more markers than were observed."""
    least, most = min(min(markers) for markers in shown), max(max(markers) for markers in shown)
    if board is None:
        return [0] if least == 0 else [0, least]
    held = board.columns * board.rows // 2
    possible = [first for first in range(least, -1, -1) if first + held > most]
    likely = [first for first in (board.first_marker, 0) if first in possible]
    return [*dict.fromkeys([*likely, *possible])]


def _explaining(shown: Sequence[Markers], columns: int, first: int, *, legacy: bool) -> Layout | None:
    corners = _layout_corners(columns, legacy=legacy)
    ratios, last = [], first
    for markers in shown:
        numbers = np.array([number for number in markers if 0 <= number - first < len(corners)])
        if len(numbers) < max(MARKERS_LEAST, 0.8 * len(markers)):
            continue
        flat, observed = corners[numbers - first], np.array([markers[number] for number in numbers.tolist()])
        miss, ratio = _fit(flat, observed)
        if miss < LAYOUT_MISS:
            ratios.append(ratio)
            last = max(last, int(numbers.max()))
    if len(ratios) <= 0.5 * len(shown):
        return None
    return Layout(columns, first, legacy, float(np.median(ratios)), last - first + 1)


def _layout_corners(columns: int, *, legacy: bool) -> Float[np.ndarray, "m 4 2"]:
    """Returns the markers' corners (in squares) of the longest possible board, with markers as wide as a square."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    rows = min(60, 2 * (len(dictionary.bytesList) // columns))
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.999, dictionary)
    board.setLegacyPattern(legacy)
    return np.array([np.asarray(points)[:, :2] for points in board.getObjPoints()], float)


def _fit(flat: Float[np.ndarray, "m 4 2"], observed: Float[np.ndarray, "m 4 2"]) -> tuple[float, float]:
    """Returns the RMS distance (squares) of the markers' centres from their layout, and a marker's side (squares)."""
    homography, _ = cv2.findHomography(observed.mean(axis=1), flat.mean(axis=1), 0)
    if homography is None or np.linalg.det(homography) <= 0:
        return np.inf, 0.0
    back = cv2.perspectiveTransform(observed.reshape(-1, 1, 2), homography).reshape(observed.shape)
    miss = float(np.sqrt(((back.mean(axis=1) - flat.mean(axis=1)) ** 2).sum(axis=1).mean()))
    sides = np.linalg.norm(np.roll(back, -1, axis=1) - back, axis=2)
    turned = ((back[:, 1] - back[:, 0]) * (flat[:, 1] - flat[:, 0])).sum(axis=1) > 0  # markers lie as the layout's do
    return (miss if turned.mean() > 0.5 else np.inf), float(np.median(sides))


def other_dictionary(greys: Iterable[UInt8[np.ndarray, "h w"]], dictionary: str) -> str | None:
    """Returns the smallest other dictionary of OpenCV that fits a picture's markers, or None."""
    sizes = {
        name: len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
        for name in dir(cv2.aruco)
        if name.startswith("DICT_") and name != dictionary
    }
    names = sorted(sizes, key=lambda name: sizes[name])
    for grey in greys:
        counts = {name: len(find_markers(grey, name)) for name in names}
        best = max(names, key=lambda name: counts[name])
        if counts[best] >= MARKERS_LEAST:
            return best
    return None


def is_april_grid(markers: Markers) -> bool:
    """Returns whether the markers fill every cell of a grid, numbered row by row, as on Kalibr's AprilGrid."""
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
    """Returns ``board`` with the first marker number and the first square's colour of ``layout``. Returns None if
    ``layout`` has another number of squares or another size of markers."""
    if layout.columns != board.columns or abs(layout.ratio - board.marker_ratio) > RATIO_OFF:
        return None
    return replace(board, legacy=layout.legacy, first_marker=layout.first_marker)
