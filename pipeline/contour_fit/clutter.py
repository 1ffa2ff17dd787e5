"""Gives zero weight to rim samples where hair, shoulders or clothes, here called clutter, may form the silhouette's
outline. Clutter can only add area to a silhouette."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.contour_fit.problem import ContourProblem, StageEvidence
from pipeline.contour_fit.rim import Rim

CLUTTER_PX, CLUTTER_SIGMAS = 3.0, 3.0  # the input lies outside the model by more: hair, ears, collar
OUTSIDE_SHARE = 0.3  # weight of a rim outside the face that sticks out: a model's neck is less sure than its face
CELL_PX, CLUTTER_CELLS = 4, 3  # clutter reaches 12 px beyond where it was found: its border slides with the fit


def downweight_outside_contour(problem: ContourProblem, evidence: StageEvidence, rim: Rim, level: str) -> Rim:
    """Reduces the weight of rim samples on cranium, ears and neck. A sample on these parts counts only if the model
    sticks out of the silhouette, and then with ``OUTSIDE_SHARE`` of its weight."""
    face = face_of(problem, evidence, level)[rim.corner].all(axis=1)
    share = np.where(rim.residual > 0, OUTSIDE_SHARE, 0.0)
    return replace(rim, length=np.where(face, rim.length, share * rim.length))


def face_of(problem: ContourProblem, evidence: StageEvidence, level: str) -> Bool[np.ndarray, " v"]:
    """Returns a mask of the vertices of a mesh level that lie in the face region and not under hair."""
    region = problem.model.levels[level].face_region
    hair = {} if evidence.photographs is None else evidence.photographs.hair
    return region & ~hair[level] if level in hair else region


def find_clutter(problem: ContourProblem, rim: Rim, threshold_px: float) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Marks the square cells (``CELL_PX`` pixels wide) of every view where the silhouette extends more than
    ``threshold_px`` beyond the model, and ``CLUTTER_CELLS`` cells around them."""
    maps = []
    for k, (width, height) in enumerate(problem.views.size):
        cells = np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), np.uint8)
        strange = (rim.view == k) & (rim.residual < -threshold_px)
        at = (rim.pixel[strange] / CELL_PX).astype(int)
        cells[at[:, 1], at[:, 0]] = 1
        maps.append(cv2.dilate(cells, np.ones((2 * CLUTTER_CELLS + 1,) * 2, np.uint8)) > 0)
    return tuple(maps)


def drop_clutter(evidence: StageEvidence, rim: Rim) -> Rim:
    """Returns the rim with zero length for the samples in cells that ``evidence`` marks as clutter."""
    if evidence.noise.clutter is None:
        return rim
    return replace(rim, length=np.where(within(evidence.noise.clutter, rim), 0.0, rim.length))


def restore_bare_crown(
    problem: ContourProblem, evidence: StageEvidence, rim: Rim, length: Float[np.ndarray, " s"], level: str
) -> Rim:
    """Restores the weight of a bald crown: rim samples above the brows, in cells marked as bald, get their full
    ``length``. All other outline samples stay unchanged."""
    if evidence.noise.bare is None:
        return rim
    bare = is_crown(problem, rim, level) & within(evidence.noise.bare, rim)
    return replace(rim, length=np.where(bare, length, rim.length))


def is_crown(problem: ContourProblem, rim: Rim, level: str) -> Bool[np.ndarray, " s"]:
    """Returns a mask of the rim samples on the crown, that is, on the head above the brows."""
    mean = problem.model.vertices(np.zeros(0), level)
    brows = problem.model.vertices(np.zeros(0))[problem.model.landmarks["glabella"], 1]
    return (mean[:, 1] > brows)[rim.corner].all(axis=1)


def within(cells: Sequence[Bool[np.ndarray, "_ _"]], rim: Rim) -> Bool[np.ndarray, " s"]:
    """Returns a mask of the rim samples in marked cells of their view. ``cells`` has one map for each view."""
    row, column = (rim.pixel / CELL_PX).astype(int).T[::-1]
    found = np.zeros(len(rim.view), bool)
    for k, marked in enumerate(cells):
        here = np.flatnonzero(rim.view == k)
        found[here] = marked[row[here], column[here]]
    return found
