"""Maps each of the face detector's 468 points to a point on a head model's surface, with the detector's error.

Points and errors were measured on renders of heads (``python -m tests.laboratory.model_packs.landmark_map``) for two
head models: MakeHuman's and ICT-FaceKit. For any other model the points are transferred from MakeHuman's mean head by
means of common landmarks, and the error of the transfer is added.

The triangulated points of the detector lie at ``map.points(vertices) + e``. The error e has the mean ``offset_mm``, a
part that is independent for each point (``deviation_mm``), and a part common to all points (``shared_mm``), because the
detector is biased towards the average face of its training.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.compute.array_cache import cached_arrays
from pipeline.geometry.registration.nonrigid import warp_by_landmarks
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, load_model
from rig.errors import EigenheadError

BUILT_IN = ("makehuman", "ict-facekit")
CARRIED_MM = 1.9  # per axis; of MakeHuman's points carried to ICT-FaceKit, against those measured there, and back
SLIDING_MM = 3.0  # per axis; a point that errs by more slides along the skin
MIN_LANDMARKS = 6  # that models share, for one to be carried to the other


class NoLandmarkMap(EigenheadError):
    """Reports a head model that has too few named landmarks for the transfer of the 468 face points."""

    def __init__(self, name: str, shared: int) -> None:
        super().__init__(
            f"faces that are found in photographs cannot be brought onto the head model {name}: it names {shared} of "
            f"the 26 landmarks, and {MIN_LANDMARKS} are needed (docs/models.md); import it again with its landmarks"
        )


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """Holds the points on a head model's surface that correspond to the detector's 468 points, and the detector's error
    at each point (mm, head frame). ``slides`` marks points that may slide along the skin (jaw line, forehead). Arrays
    are read-only."""

    rows: Int[np.ndarray, "468 3"]  # vertices of the full level
    weights: Float[np.ndarray, "468 3"]  # of them; each row sums to 1
    offset_mm: Float[np.ndarray, "468 3"]  # mean of found minus true
    deviation_mm: Float[np.ndarray, "468 3"]  # along each axis, of each point by its own
    shared_mm: Float[np.ndarray, "m 468 3"]  # modes, each times a standard normal number
    slides: Bool[np.ndarray, " 468"]  # jaw line, forehead: better left out of what looks for single points

    def points(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "468 3"]:
        """Returns the 468 surface points of a head whose full mesh has these vertices, in the frame of the vertices."""
        return (vertices[self.rows] * self.weights[..., None]).sum(axis=1)

    def expected(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "468 3"]:
        """Returns the surface points plus the detector's mean error at each of them (mm, head frame)."""
        return self.points(vertices) + self.offset_mm

    def covariance(self, which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "p p"]:
        """Returns the covariance of the detector's errors at the points ``which`` (mm^2, head frame), in the order x y
        z of the first point, x y z of the second point and so on."""
        modes = self.shared_mm[:, which].reshape(len(self.shared_mm), -1)
        return modes.T @ modes + np.diag(self.deviation_mm[which].ravel() ** 2)


def landmark_map(model: HeadModel) -> LandmarkMap:
    """Returns the landmark map of a head model. Models with the triangles of a built-in model have a measured map; for
    other models the points are transferred from the default model's mean head. Raises NoLandmarkMap if the model names
    too few landmarks."""
    digest = faces_digest(model)
    for name in BUILT_IN:
        if str(_table()[f"{name}_faces"]) == digest:
            return built_in_map(name)
    carried = _carried(model)
    offset = np.mean([_table()[f"{name}_offset_mm"] for name in BUILT_IN], axis=0)
    return _map(carried["rows"], carried["weights"], offset, CARRIED_MM)


def built_in_map(name: str) -> LandmarkMap:
    """Returns the measured landmark map of a built-in model, ``makehuman`` or ``ict-facekit``."""
    table = _table()
    return _map(table[f"{name}_rows"], table[f"{name}_weights"], table[f"{name}_offset_mm"], 0.0)


def faces_digest(model: HeadModel) -> str:
    """Returns the SHA-256 of the triangles of a head model's full mesh. Models with the same triangles share one
    landmark map."""
    faces = np.ascontiguousarray(model.levels["full"].faces, np.int32)
    return hashlib.sha256(faces.tobytes()).hexdigest()


def _map(rows: np.ndarray, weights: np.ndarray, offset_mm: np.ndarray, carried_mm: float) -> LandmarkMap:
    table = _table()
    shared = table["shared_mm"].astype(float)
    deviation = np.sqrt(table["deviation_mm"].astype(float) ** 2 + carried_mm**2)
    total = np.sqrt((deviation**2 + (shared**2).sum(axis=0)).mean(axis=1))
    weights = weights.astype(float)
    arrays = (
        rows.astype(int), weights / weights.sum(axis=1, keepdims=True), offset_mm.astype(float), deviation, shared,
        total > np.hypot(SLIDING_MM, carried_mm),
    )  # fmt: skip
    for array in arrays:
        array.flags.writeable = False
    return LandmarkMap(*arrays)


def _carried(model: HeadModel) -> Mapping[str, np.ndarray]:
    """Transfers the default model's points to another model. Returns each point's vertices and weights."""
    marks = model.levels["full"].landmarks
    default = load_model()
    names = sorted(set(marks) & set(default.levels["full"].landmarks))
    if len(names) < MIN_LANDMARKS:
        raise NoLandmarkMap(model.name, len(names))
    faces, mean = model.levels["full"].faces, model.vertices(np.zeros(0))
    targets = mean[[marks[name] for name in names]]

    def make() -> dict[str, np.ndarray]:
        vertices = default.vertices(np.zeros(0))
        sources = vertices[[default.levels["full"].landmarks[name] for name in names]]
        points = landmark_map(default).points(vertices)
        hits = SurfaceIndex(mean, faces).closest(warp_by_landmarks(sources, targets, points))
        return {"rows": faces[hits.triangles], "weights": hits.weights}

    table = _table()
    inputs = (
        mean,
        np.asarray(faces),
        targets,
        names,
        default.sha256,
        table["makehuman_rows"],
        table["makehuman_weights"],
    )
    return cached_arrays("landmark-map", inputs, make, made_by=(SurfaceIndex, warp_by_landmarks))


@cache
def _table() -> Mapping[str, np.ndarray]:
    with np.load(Path(__file__).parent / "packs" / "landmark_maps.npz", allow_pickle=False) as table:
        return {name: table[name] for name in table.files}
