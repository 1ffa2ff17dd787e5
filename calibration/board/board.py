"""Describes the calibration board, prints it, computes its corners, and simulates its picture in a camera.

The board frame is right-handed and matches OpenCV's. The frame's origin is the outer corner of the first square. The
board's x axis runs along a row of squares, y down a column, and z *into* the board (away from the viewer). The board's
first square is normally black. The first square of an ``inverted`` board is white. The first square is also white if a
ChArUco board with an even number of rows is ``legacy``, as drawn by OpenCV before 4.6 and calib.io. The term corner
means an inner corner; corners are numbered row by row.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from fpdf import FPDF
from jaxtyping import Bool, Float, Int, UInt8

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.geometry import RigidTransform, rotation_from_vector
from rig.messages.message import Message, compose
from rig.text import as_utf8

Kind = Literal["checkerboard", "charuco"]
SQUARES_LEAST, SQUARES_MOST = 3, 60
PAPERS_MM = {
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
MARGIN_MM = 8.0  # what common printers leave blank
FOOT_MM = 22.0  # ruler and caption
RULER_MM = 100
SHEET_PX = 40  # of a square in the drawing that simulated cameras see
RAY_STEP_PX = 8  # rays are cast that far apart: a cubic spline between them is exact to 1e-4 of a square
FAN_DEG = 150.0  # azimuths that a simulated board faces in turn


@dataclass(frozen=True, slots=True)
class Board:
    """Describes a calibration board; ``columns`` and ``rows`` count squares. ``measured_width_mm`` and
    ``measured_height_mm`` are the outer size of the printed pattern, measured with a ruler, to check the scale."""

    kind: Kind
    columns: int
    rows: int
    square_mm: float
    marker_ratio: float = 0.75
    dictionary: str = "DICT_4X4_1000"
    inverted: bool = False
    legacy: bool = False
    first_marker: int = 0
    measured_width_mm: float | None = None
    measured_height_mm: float | None = None

    @property
    def grid(self) -> tuple[int, int]:
        """Returns the numbers of inner corners as (columns, rows), which is OpenCV's pattern size."""
        return self.columns - 1, self.rows - 1

    @property
    def corner_count(self) -> int:
        """Returns the number of inner corners."""
        return self.grid[0] * self.grid[1]

    @property
    def marker_count(self) -> int:
        """Returns the number of markers on a ChArUco board, one in every white square."""
        return self.columns * self.rows // 2

    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Returns the positions of the inner corners (mm) in the board frame, row by row."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_mm * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    def centre(self) -> Float[np.ndarray, " 3"]:
        """Returns the middle of the board (mm) in the board frame."""
        return 0.5 * self.square_mm * np.array([self.columns, self.rows, 0.0])

    def turns(self) -> list[Int[np.ndarray, " _"]]:
        """Returns an order of the corners for each rotation of the board that leaves its colours unchanged. After a
        board's rotation, corner ``order[i]`` appears at the position of corner i. A ChArUco board has only one order,
        because its markers differ."""
        index = np.arange(self.corner_count).reshape(self.rows - 1, self.columns - 1)
        if self.kind == "charuco":
            return [index.ravel()]
        # Turned by 90 degrees the square (0, 0) lands on (columns - 1, 0), by 180 on (columns - 1, rows - 1); the
        # colours agree where those two are of one colour, that is where the sum of their places is even.
        orders = [index]
        if (self.columns + self.rows) % 2 == 0:
            orders.append(index[::-1, ::-1])
        if self.columns == self.rows and self.columns % 2 == 1:
            orders += [np.rot90(index), np.rot90(index, 3)]
        return [np.ascontiguousarray(order).ravel() for order in orders]

    @property
    def is_chiral(self) -> bool:
        """Returns whether the pattern differs from its mirror image, so that pictures of the board reveal a mirrored
        camera. A checkerboard that is square or has an odd side equals its mirror image."""
        if self.kind == "charuco":
            return True
        return self.columns % 2 == 0 and self.rows % 2 == 0 and self.columns != self.rows

    def squares(self) -> Bool[np.ndarray, "rows columns"]:
        """Returns True for each black square."""
        row, column = np.indices((self.rows, self.columns))
        white_first = self.kind == "charuco" and self.legacy and self.rows % 2 == 0
        return ((row + column) % 2 == 0) ^ self.inverted ^ white_first

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """Returns a ChArUco board as an object of OpenCV."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        size = (self.columns, self.rows)
        numbers = np.arange(self.marker_count) + self.first_marker
        board = cv2.aruco.CharucoBoard(size, self.square_mm, self.square_mm * self.marker_ratio, dictionary, numbers)
        board.setLegacyPattern(self.legacy)
        return board


def read_board(path: Path) -> Board:
    """Reads a board from a ``board.toml`` file. Raises an InputError that names every fault."""
    try:
        document = tomllib.loads(as_utf8(path.read_bytes()).decode())
    except (OSError, ValueError, RecursionError) as error:
        other = path.suffix.lower() != ".toml" or isinstance(error, UnicodeDecodeError)
        fault = compose("board-not-described") if other else compose("no-toml", reason=str(error))
        raise InputError(path.name, [fault]) from error
    return board_from_document(document, path.name)


def board_from_document(document: Mapping[str, Any], subject: str = "board.toml") -> Board:
    """Returns the board that a decoded ``board.toml`` describes. Raises an InputError that names every fault."""
    known = set(Board.__dataclass_fields__)
    strange = [key for key in document if key not in known]
    faults = [compose("board-key-unknown", key=f"{key!r}", known=sorted(known)) for key in strange]
    faults += [
        compose("key-missing-in", key=key) for key in ("kind", "columns", "rows", "square_mm") if key not in document
    ]
    kind = document.get("kind")
    if kind not in ("checkerboard", "charuco", None):
        faults.append(compose("board-kind", kind=f"{kind!r}"))
    for key in ("columns", "rows"):
        value = document.get(key, SQUARES_LEAST)
        if isinstance(value, bool) or not isinstance(value, int) or not SQUARES_LEAST <= value <= SQUARES_MOST:
            printed = f"{value!r}"
            faults.append(compose("board-squares", key=key, value=printed, least=SQUARES_LEAST, most=SQUARES_MOST))
    ranges = {"square_mm": (0.5, 1000.0), "marker_ratio": (0.3, 0.95)}
    ranges |= {key: (1.0, 1e5) for key in ("measured_width_mm", "measured_height_mm")}
    for key, (least, most) in ranges.items():
        value = document.get(key, least)
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            faults.append(compose("board-number", key=key, value=f"{value!r}", least=least, most=most))
    for key in ("inverted", "legacy"):
        if not isinstance(document.get(key, False), bool):
            faults.append(compose("no-switch", key=key, value=f"{document[key]!r}"))
    first = document.get("first_marker", 0)
    if isinstance(first, bool) or not isinstance(first, int) or not 0 <= first < 10_000:
        faults.append(compose("board-first-marker", value=f"{first!r}"))
    faults += _dictionary_faults(document) if not faults and kind == "charuco" else []
    if faults:
        raise InputError(subject, faults)
    floats = {key: float(document[key]) for key in ranges if key in document}
    return Board(**{**document, **floats})


def _dictionary_faults(document: Mapping[str, Any]) -> list[Message]:
    name = document.get("dictionary", "DICT_4X4_1000")
    if not isinstance(name, str) or not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        return [compose("board-dictionary", name=f"{name!r:.60}")]
    held = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
    wanted = document.get("first_marker", 0) + document["columns"] * document["rows"] // 2
    return [compose("dictionary-small", dictionary=name, held=held, wanted=wanted)] if held < wanted else []


def write_board(board: Board, path: Path) -> None:
    """Writes a board as a ``board.toml`` file."""
    lines = [f'kind = "{board.kind}"', f"columns = {board.columns}  # squares", f"rows = {board.rows}"]
    lines.append(f"square_mm = {board.square_mm!r}")
    if board.kind == "charuco":
        lines += [
            f"marker_ratio = {board.marker_ratio!r}  # marker side / square side",
            f'dictionary = "{board.dictionary}"',
        ]
        lines += ["legacy = true  # the first square is white"] if board.legacy else []
        lines += [f"first_marker = {board.first_marker}"] if board.first_marker else []
    lines.append(f"inverted = {str(board.inverted).lower()}")
    for key in ("measured_width_mm", "measured_height_mm"):
        value = getattr(board, key)
        lines.append(f"# {key} = {board.square_mm * _side(board, key):g}" if value is None else f"{key} = {value!r}")
    if board.measured_width_mm is None:
        lines.append("# measure the printed pattern with a ruler, outer edge to outer edge, and enter it above")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _side(board: Board, key: str) -> int:
    return board.columns if "width" in key else board.rows


def write_board_pdf(board: Board, path: Path) -> tuple[float, float]:
    """Writes the board and a ruler to a PDF at true scale. Returns the size (mm) of the smallest paper that fits."""
    width, height = board.columns * board.square_mm, board.rows * board.square_mm
    page = _paper(width, height)
    pdf = FPDF(unit="mm", format=page)
    pdf.set_creation_date(datetime(2000, 1, 1, tzinfo=UTC))  # the same board gives the same bytes
    pdf.set_margins(0, 0, 0)
    pdf.set_auto_page_break(False)
    pdf.add_page()
    left, top = (page[0] - width) / 2, max(MARGIN_MM, (page[1] - FOOT_MM - height) / 2)
    pdf.set_fill_color(0)
    if board.inverted:  # the detectors want a rim of the lighter colour, which is black here
        rim = min(board.square_mm / 2, left, top)
        pdf.rect(left - rim, top - rim, width + 2 * rim, height + 2 * rim, style="F")
    for x, y, w, h, white in _rectangles(board):
        pdf.set_fill_color(255 if white else 0)
        pdf.rect(left + x, top + y, w, h, style="F")
    _draw_foot(pdf, board, page)
    write_atomically(path, bytes(pdf.output()))
    return page


def _paper(width: float, height: float) -> tuple[float, float]:
    needed = width + 2 * MARGIN_MM, height + MARGIN_MM + FOOT_MM
    for short, long in PAPERS_MM.values():
        for page in ((short, long), (long, short)):
            if needed[0] <= page[0] and needed[1] <= page[1]:
                return page
    return max(needed[0], RULER_MM + 2 * MARGIN_MM), needed[1]


def _rectangles(board: Board) -> list[tuple[float, float, float, float, bool]]:
    """Returns x, y, width and height (mm) of each printed rectangle, and whether it is white, in drawing order."""
    side = board.square_mm
    paint = board.inverted  # white squares on black paper, or black on white
    squares = [
        (c * side, r * side, side, side, paint) for r, c in zip(*np.nonzero(board.squares() ^ paint), strict=True)
    ]
    if board.kind == "charuco":
        for number, corners in enumerate(board.opencv().getObjPoints()):
            x, y = np.asarray(corners)[:, :2].min(axis=0)
            squares += _marker(board, board.first_marker + number, float(x), float(y))
    return squares


def _marker(board: Board, number: int, x: float, y: float) -> list[tuple[float, float, float, float, bool]]:
    dictionary = board.opencv().getDictionary()
    cells = dictionary.markerSize + 2
    black = cv2.aruco.generateImageMarker(dictionary, number, cells, borderBits=1) == 0
    cell = board.square_mm * board.marker_ratio / cells
    runs = []
    # Runs along rows and along columns overlap, so that no viewer shows hairlines between neighbouring cells.
    for row, first, last in _runs(black):
        runs.append((x + first * cell, y + row * cell, (last - first) * cell, cell, board.inverted))
    for column, first, last in _runs(black.T):
        runs.append((x + column * cell, y + first * cell, cell, (last - first) * cell, board.inverted))
    return runs


def _runs(cells: Bool[np.ndarray, "n n"]) -> list[tuple[int, int, int]]:
    """Returns (row, first column, one past the last column) for every run of True cells."""
    padded = np.pad(cells, ((0, 0), (1, 1))).astype(np.int8)
    steps = np.diff(padded, axis=1)
    starts, ends = np.argwhere(steps == 1), np.argwhere(steps == -1)
    return [(int(line), int(first), int(last)) for (line, first), (_, last) in zip(starts, ends, strict=True)]


def _draw_foot(pdf: FPDF, board: Board, page: tuple[float, float]) -> None:
    left, base = max(MARGIN_MM, (page[0] - RULER_MM) / 2), page[1] - MARGIN_MM - 2.0
    pdf.set_fill_color(0)
    for millimetre in range(RULER_MM + 1):
        length = 5.0 if millimetre % 10 == 0 else 3.5 if millimetre % 5 == 0 else 2.0
        pdf.rect(left + millimetre - 0.05, base - length, 0.1, length, style="F")
    pdf.set_font("Helvetica", size=6)
    for centimetre in range(0, RULER_MM + 1, 10):
        pdf.text(left + centimetre - 1.2, base + 2.5, str(centimetre))
    kind = f"{board.kind}, {board.columns} x {board.rows} squares of {board.square_mm:g} mm"
    if board.kind == "charuco":
        kind += f", {board.dictionary}, marker ratio {board.marker_ratio:g}"
    pdf.set_font("Helvetica", size=7)
    pdf.text(left, base - 9.5, kind)
    pdf.text(
        left,
        base - 6.5,
        "Print at 100 % (no scaling). The ruler must measure 100 mm; glue the sheet to a flat, stiff plate.",
    )


def board_poses(board: Board, count: int, rng: np.random.Generator) -> list[RigidTransform]:
    """Draws random poses world_from_board (mm) near the world's origin, as if a person turned the board from one side
    of the rig to the other."""
    poses = []
    for azimuth in np.radians(FAN_DEG * ((np.arange(count) + 0.5) / count - 0.5)):
        # The board's z points away from the viewer: for a viewer on +z of the world, x right is world x, y down is -y.
        turn = rotation_from_vector(np.array([0.0, azimuth, 0.0]))
        tilt = rotation_from_vector(np.radians(rng.uniform(-35, 35, 3)))
        rotation = turn @ tilt @ np.diag([1.0, -1.0, -1.0])
        poses.append(RigidTransform(rotation, rng.uniform(-60, 60, 3) - rotation @ board.centre()))
    return poses


def photograph_board(
    board: Board, world_from_board: RigidTransform, camera: Camera, rng: np.random.Generator, *, blur_px: float = 0.6
) -> UInt8[np.ndarray, "h w"]:
    """Simulates a noisy picture of the board before a plain wall. A camera behind the board sees white paper. OpenCV
    draws the pattern, because a test of ``write_board_pdf`` needs an independent drawing."""
    from scipy.interpolate import RectBivariateSpline

    k, side = camera.intrinsics, 2  # samples of a pixel's side
    us, vs = (np.arange(-1.0 * RAY_STEP_PX, size + 2 * RAY_STEP_PX, RAY_STEP_PX) for size in (k.width, k.height))
    board_from_world = world_from_board.inverse()
    rays = camera.rays_world(np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 2)) @ board_from_world.rotation.T
    centre = board_from_world.apply(camera.centre_world[None])[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = centre[:2] - centre[2] / rays[:, 2:] * rays[:, :2]
    nodes = ((hit / board.square_mm + 1.0) * SHEET_PX - 0.5).reshape(len(vs), len(us), 2)
    down, along = ((np.arange(size * side) + 0.5) / side - 0.5 for size in (k.height, k.width))
    x, y = (RectBivariateSpline(vs, us, nodes[..., axis])(down, along).astype(np.float32) for axis in range(2))
    sheet = _sheet(board) if centre[2] < 0 else np.full_like(_sheet(board), 255)
    picture = cv2.remap(sheet, x, y, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    picture = cv2.resize(picture, (k.width, k.height), interpolation=cv2.INTER_AREA).astype(float)
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px else picture
    return np.clip(0.75 * picture + 25 + rng.normal(scale=2.0, size=picture.shape), 0, 255).astype(np.uint8)


def _sheet(board: Board) -> UInt8[np.ndarray, "h w"]:
    """Draws the printed sheet, with a margin as wide as a square around the pattern."""
    size = (board.columns * SHEET_PX, board.rows * SHEET_PX)
    if board.kind == "charuco":
        sheet = board.opencv().generateImage(size)
    else:
        row, column = np.indices((board.rows, board.columns))
        sheet = np.kron((row + column) % 2 * 255, np.ones((SHEET_PX, SHEET_PX))).astype(np.uint8)
    sheet = np.pad(sheet, SHEET_PX, constant_values=255)
    return 255 - sheet if board.inverted else sheet
