"""Measures where in each camera's picture the board was seen, and advises the person who carries it on the next
shot."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from calibration.board.board import board_from_document
from calibration.board.corners import detect
from rig.messages.message import Message, compose
from rig.progress import Progress
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext

CELLS = (4, 3)  # of an image, across and down, that corners should fall into
CORNERS_SHOWN = 60
CELLS_ENOUGH = 0.75
VIEWS_ENOUGH = 6  # per camera: Zhang's method has nothing more to gain from the count of views than that

Corners = dict[str, list[list[float]]]  # of a shot, by camera: shares of the image's width and height


def detect_shot(context: WorkerContext, report: Progress, *, files: str, board: Mapping[str, object]) -> Corners:
    """Finds the corners of the board in each image of a capture, in a child process. Returns the corners by camera, as
    fractions of width and height; the list is empty without a board. Raises InputError for an impossible board."""
    described = board_from_document(board)
    corners = {}
    for number, path in enumerate(sorted((Path(files) / "images").iterdir())):
        report("detect", number / 64)
        grey = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
        detection = None if grey is None else detect(grey.astype(np.uint8, copy=False), described)
        if grey is None or detection is None:
            corners[path.stem] = []
        else:
            corners[path.stem] = (detection.corners / (grey.shape[1], grey.shape[0])).round(4).tolist()
    return corners


def covered(corners: Float[np.ndarray, "n 2"]) -> float:
    """Computes the fraction of a picture's ``CELLS`` that hold a corner of the board. The coordinates of a corner are
    fractions of width and height."""
    if len(corners) == 0:
        return 0.0
    cells = np.clip((corners * CELLS).astype(int), 0, np.array(CELLS) - 1)
    return len(np.unique(cells, axis=0)) / (CELLS[0] * CELLS[1])


def summary(cameras: list[str], shots: list[Corners]) -> list[JsonObject]:
    """Computes how much of each camera's picture the board has covered so far: the number of pictures that show the
    board (``views``), the fraction ``covered``, whether this is enough, and the ``corners`` in earlier shots and in the
    ``last`` shot, as fractions of width and height."""
    lines: list[JsonObject] = []
    for name in cameras:
        seen = [shot[name] for shot in shots if shot.get(name)]
        corners = np.array([corner for shot in seen for corner in shot]).reshape(-1, 2)
        share = covered(corners)
        last = shots[-1].get(name, []) if shots else []
        lines.append(
            {
                "name": name,
                "views": len(seen),
                "covered": round(share, 3),
                "enough": len(seen) >= VIEWS_ENOUGH and share >= CELLS_ENOUGH,
                "corners": [c for shot in seen[:-1] for c in _thinned(shot)]
                if last
                else [c for s in seen for c in _thinned(s)],
                "last": _thinned(last),
            }
        )
    return lines


def advice(lines: list[JsonObject]) -> Message:
    """Returns a message that says what the person with the board should do next."""
    if not lines or not any(line["views"] for line in lines):
        return compose("board-hold")
    blind = [line["name"] for line in lines if line["views"] == 0]
    if blind:
        return compose("board-turn-to", cameras=blind)
    poor = sorted((line for line in lines if not line["enough"]), key=lambda line: (line["covered"], line["views"]))
    if poor:
        return compose("board-cover", cameras=[line["name"] for line in poor[:3]])
    return compose("board-covered")


def _thinned(corners: list[list[float]]) -> list[list[float]]:
    return corners[:: max(1, len(corners) // CORNERS_SHOWN)]
