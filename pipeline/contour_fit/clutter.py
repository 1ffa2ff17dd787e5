"""Hair, shoulders and clothes only ever add area to a silhouette: which stretches of a rim do not count for that."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.contour_fit.problem import ContourProblem, StageEvidence
from pipeline.contour_fit.rim import Rim

CLUTTER_PX, CLUTTER_SIGMAS = 3.0, 3.0  # the input lies outside the model by more: hair, ears, collar
OUTSIDE_SHARE = 0.3  # weight of a rim outside the face that sticks out: a model's neck is less sure than its face
CELL_PX, CLUTTER_CELLS = 4, 3  # clutter reaches 12 px beyond where it was found: its border slides with the fit


def downweight_outside_contour(problem: ContourProblem, evidence: StageEvidence, rim: Rim, level: str) -> Rim:
    """Returns the rim with less weight outside the face: on cranium, ears and neck a sample counts only where the model
    sticks out of the silhouette, and then with ``OUTSIDE_SHARE`` of its weight."""
    face = face_of(problem, evidence, level)[rim.corner].all(axis=1)
    share = np.where(rim.residual > 0, OUTSIDE_SHARE, 0.0)
    return replace(rim, length=np.where(face, rim.length, share * rim.length))


def face_of(problem: ContourProblem, evidence: StageEvidence, level: str) -> Bool[np.ndarray, " v"]:
    """Tells which vertices of a level lie in the face region and not under hair."""
    region = problem.model.levels[level].face_region
    hair = {} if evidence.photographs is None else evidence.photographs.hair
    return region & ~hair[level] if level in hair else region


def find_clutter(problem: ContourProblem, rim: Rim, threshold_px: float) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Marks, in every view, the cells of ``CELL_PX`` pixels where the silhouette reaches farther than ``threshold_px``
    beyond the model, and the cells around them."""
    maps = []
    for k, (width, height) in enumerate(problem.views.size):
        cells = np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), np.uint8)
        strange = (rim.view == k) & (rim.residual < -threshold_px)
        at = (rim.pixel[strange] / CELL_PX).astype(int)
        cells[at[:, 1], at[:, 0]] = 1
        maps.append(cv2.dilate(cells, np.ones((2 * CLUTTER_CELLS + 1,) * 2, np.uint8)) > 0)
    return tuple(maps)


def without_clutter(evidence: StageEvidence, rim: Rim) -> Rim:
    """Returns the rim with zero weight for the samples in cells marked as clutter."""
    if evidence.noise.clutter is None:
        return rim
    cell = (rim.pixel / CELL_PX).astype(int)
    length = rim.length.copy()
    for k, cells in enumerate(evidence.noise.clutter):
        here = np.flatnonzero(rim.view == k)
        length[here[cells[cell[here, 1], cell[here, 0]]]] = 0.0
    return replace(rim, length=length)
