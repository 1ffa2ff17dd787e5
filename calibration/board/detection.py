"""Finds the board in many pictures, in parallel, and caches the results by the pictures' content. ``corners`` examines
one picture."""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from calibration.board.board import SQUARES_LEAST, Board
from calibration.board.corners import Found, classic_corners, detect, in_board_order, pattern_continues
from calibration.board.markers import (
    MARKERS_LEAST,
    RATIO_OFF,
    Markers,
    board_of,
    find_layout,
    find_markers,
    is_april_grid,
    other_dictionary,
)
from calibration.board.picture_files import filed_by_shot, list_pictures
from rig.atomic_write import write_atomically
from rig.errors import EigenheadError, InputError
from rig.messages.message import Message, compose
from rig.progress import Progress

VERSION = 2  # of the detector: part of the cache's key
EXPLAINED = 4  # pictures of a blind camera that are looked at twice
MEASURED = 24  # pictures whose markers are measured where the board is not found as it was described ...
SHARP_PX = 4.0  # of an edge: 1.5 in focus; the edges of markers beside a square's corner are 5 px and more apart
TRIED = 6  # pictures in which the markers of all dictionaries are looked for
FEW_FOUND = 0.2  # ... that is in less than this share of them


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Holds what one camera saw of the board in one shot."""

    camera: str
    shot: str
    found: Found


@dataclass(frozen=True, slots=True)
class PictureNote:
    """Holds why the board was not found in a picture of a camera."""

    camera: str
    picture: str
    reason: Message

    def message(self) -> Message:
        """Returns the note as a message that names the picture and the reason."""
        return compose("located", where=f"{self.camera}/{self.picture}", fault=self.reason)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Holds where the board was found in all pictures.

    Attributes:
        board: as it is, perhaps corrected.
        sizes: width and height of each camera's pictures, px.
        shots: their names.
        views: the corners that each camera saw in each shot.
        missed: camera and shot of each picture without the board.
        notes: for cameras that never see the board, what their pictures show instead.
        remarks: how the board differs from its description.
    """

    board: Board
    sizes: dict[str, tuple[int, int]]
    shots: tuple[str, ...]
    views: tuple[View, ...]
    missed: tuple[tuple[str, str], ...]
    notes: tuple[PictureNote, ...] = ()
    remarks: tuple[Message, ...] = ()

    @property
    def corner_count(self) -> int:
        """Returns the number of corners in all views."""
        return sum(len(view.found.ids) for view in self.views)


class WrongBoard(EigenheadError):
    """Reports that the pictures show another board than the one that was described."""

    def __init__(self, reasons: Iterable[Message]) -> None:
        super().__init__(compose("wrong-board", notes=tuple(reasons)))


def reasons_of(notes: Iterable[PictureNote]) -> list[Message]:
    """Returns each reason once, with the pictures that it holds for."""
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


def ignore_progress(stage: str, fraction: float) -> None:
    """Does nothing: the default for callers that need no progress."""


def detect_folder(
    folder: Path,
    board: Board,
    *,
    cache: Path | None = None,
    workers: int = 2,
    together: bool = True,
    report: Progress = ignore_progress,
) -> Detections:
    """Finds the board in every picture of ``folder``. A ChArUco board is also found if its first square is white, or if
    its markers begin at another number than described.

    ``cache`` is a folder that keeps results by the pictures' SHA-256; ``together``: cameras must share shots. Raises
    InputError for damaged input, and WrongBoard if no picture shows the board and some show another.
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
    """Returns the board with the pattern that its markers have, if it is not found as described. Raises WrongBoard
    where its markers are not as wide as described: their edges then pass for blur."""
    board = detections.board
    paths = [path for shots in pictures.values() for path in shots.values()]
    found_share = len(detections.views) / len(paths)
    sample = paths[:: max(1, len(paths) // MEASURED)]
    greys = [grey for path in sample if (grey := _decode(path.read_bytes())) is not None]
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
    """Raises WrongBoard where pictures that should show a checkerboard show markers. Some squares of a ChArUco board
    pass for a checkerboard, and the markers' edges for blur."""
    paths = [path for shots in pictures.values() for path in shots.values()]
    sample = paths[:: max(1, len(paths) // TRIED)][:TRIED]
    greys = [grey for path in sample if (grey := _decode(path.read_bytes())) is not None]
    dictionary = other_dictionary(greys, "")
    if dictionary is not None:
        raise WrongBoard([compose("board-has-markers", dictionary=dictionary)])


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
    views, missed = [], []
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
        if detection is None:
            missed.append((camera, shot))
        else:
            views.append(View(camera, shot, detection))
    if faults:
        raise InputError(folder.name, faults)
    shots = tuple(sorted({shot for _, shot, _ in tasks}))
    notes = _explain_missing(pictures, sizes, views, board)
    return Detections(board, sizes, shots, tuple(views), tuple(missed), tuple(notes))


def _detect_file(path: Path, board: Board, cache: Path | None) -> tuple[tuple[int, int], Found | None] | Message:
    """Returns the picture's size and its detection, or the file's fault."""
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
    """Returns what the pictures of cameras that never see the board show instead, if that is recognised."""
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
    """Explains by a picture's markers why the board was not found."""
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
