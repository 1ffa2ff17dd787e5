"""Defines eigenhead models (the paper's section 3.1, eq. 1): a mean head, its modes, and its meshes of several
resolutions, called levels.

A model is stored as a coarse control mesh, the cage (mean and modes), and a linear operator from the cage's vertices to
each level's vertices. The default model is refined from its cage by Loop subdivision to at least 48,000 vertices. An
imported model has exactly the vertices of its source file. Modes are scaled by their standard deviation, so
coefficients are N(0, 1) (the paper's alpha_m equals sigma_m z_m).

A loaded model takes 12 (M + 1) V0 bytes for mean and modes (5 MB for the default's 137 modes), plus about 20 bytes for
each entry of an operator (13 MB). ``basis`` caches the modes at all vertices of a level: 12 M V bytes (36 MB for the
finest mesh and 60 modes)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int

from pipeline.head_model.expressions import Expressions, no_expressions
from pipeline.head_model.model_file import ModelParts, read_parts
from pipeline.head_model.model_names import model_path
from pipeline.head_model.subdivision import boundary_vertices, refine, row_count

MODES_AT_ONCE = 16  # in double precision: they stay in the processor's cache


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Holds one level of a head model, which is a mesh of one resolution. The level's vertices are ``operator @
    vertices_cage``; faces are anticlockwise seen from outside."""

    faces: Int[np.ndarray, "F 3"]
    operator: sparse.csr_array  # (V, V0)
    face_region: Bool[np.ndarray, " V"]  # ear to ear, lower forehead to under the chin
    boundary: Bool[np.ndarray, " V"]  # on an open edge of the mesh
    landmarks: Mapping[str, int]  # those of the 26 that are vertices here
    rows: Int[np.ndarray, " V"]  # the same vertices in the full level

    @property
    def count(self) -> int:
        """Returns the number of vertices of this level."""
        return row_count(self.operator)


@dataclass(frozen=True, slots=True, eq=False)
class HeadModel:
    """Holds an eigenhead model, H(z) = mean + sum_m z_m modes_m (eq. 1), in the head frame (mm).
    Arrays are read-only."""

    name: str
    licence: str
    source: str
    notice: str
    sha256: str
    subjects: Mapping[str, int]  # total, male, female
    mean: Float32[np.ndarray, "V0 3"]
    modes: Float32[np.ndarray, "M V0 3"]  # mm per standard deviation
    sigma: Float32[np.ndarray, " M"]  # sqrt(lambda_m), mm
    landmarks: Mapping[str, int]  # 26 names to vertex indices of the full level (all lie in the cage)
    levels: Mapping[str, Level]  # full, p95, p99, cage
    figures: Mapping[str, float]  # what was measured when the model was built, e.g. generalisation_mm
    scores: Float32[np.ndarray, "N C"]  # coefficients of the training heads; N = 0 where they are not known
    expressions: Expressions  # none where the model has none
    posed: range = range(0)  # which of ``modes`` are expressions, their coefficients weights (``with_expressions``)
    _bases: dict[tuple[str, int], np.ndarray] = field(default_factory=dict, repr=False)

    def cage(self, coefficients: Float[np.ndarray, " m"]) -> Float[np.ndarray, "V0 3"]:
        """Returns the vertices of the coarse control mesh, the cage (head frame, mm), for the first m coefficients, in
        standard deviations. Raises ValueError if there are more coefficients than modes."""
        count = len(coefficients)
        if count > len(self.modes):
            raise ValueError(f"{count} coefficients, but model {self.name} has {len(self.modes)} modes")
        flat, found = self.modes[:count].reshape(count, self.mean.size), self.mean.ravel().astype(float)
        for first in range(0, count, MODES_AT_ONCE):
            some = slice(first, first + MODES_AT_ONCE)
            found += np.asarray(coefficients[some], float) @ flat[some].astype(float)
        return found.reshape(-1, 3)

    def vertices(self, coefficients: Float[np.ndarray, " m"], level: str = "full") -> Float[np.ndarray, "V 3"]:
        """Returns the vertices of the mesh ``level`` (head frame, mm) for the first m coefficients, in standard
        deviations. Raises KeyError for an unknown level."""
        return self.levels[level].operator @ self.cage(coefficients)

    def posed_vertices(
        self, coefficients: Float[np.ndarray, " m"], weights: Mapping[str, float], level: str = "full"
    ) -> Float[np.ndarray, "V 3"]:
        """Returns the vertices of the mesh ``level`` (head frame, mm) with expressions added; ``weights`` are indexed
        by expression name. Raises KeyError for an unknown level or expression."""
        return self.levels[level].operator @ (self.cage(coefficients) + self.expressions.moved(weights))

    def basis(
        self, level: str, count: int, vertices: Int[np.ndarray, " S"] | None = None
    ) -> Float32[np.ndarray, "m S 3"]:
        """Returns the first ``count`` modes at all vertices of the mesh ``level``, or only at the indices ``vertices``
        (mm per standard deviation).

        The modes at all vertices are cached and read-only; those at a few vertices are computed anew."""
        if vertices is not None:
            return self._rows(self.levels[level].operator[np.asarray(vertices)], count)
        key = (level, count)
        if key not in self._bases:
            self._bases[key] = _frozen(self._rows(self.levels[level].operator, count))
        return self._bases[key]

    def _rows(self, operator: sparse.csr_array, count: int) -> Float32[np.ndarray, "m S 3"]:
        used = np.unique(operator.indices)  # a few landmarks lean on a few cage vertices: the rest is not even read
        stacked = self.modes[:count, used].transpose(1, 0, 2).reshape(len(used), -1)
        rows = operator[:, used].astype(np.float32) @ stacked
        return np.ascontiguousarray(rows.reshape(-1, count, 3).transpose(1, 0, 2))


def assemble(parts: ModelParts, sha256: str) -> HeadModel:
    """Builds the model in memory from the parts of a model file: operators, borders and landmarks of every mesh. Arrays
    become read-only."""
    count = len(parts.mean)
    expressions = parts.expressions or no_expressions(count)
    full, full_faces = refine(parts.faces, count, parts.subdivisions)
    region = full @ parts.face_region.astype(float) > 0.5
    index = {
        "full": (np.arange(row_count(full)), full_faces),
        "cage": (np.arange(count), parts.faces),
        **parts.decimated,
    }
    levels = {}
    for name, (rows, faces) in index.items():
        # the cage is a level of its own (control points), not rows of the full one
        operator = sparse.csr_array(sparse.identity(count, format="csr")) if name == "cage" else full
        operator = operator if name in ("full", "cage") else sparse.csr_array(full[rows])
        levels[name] = _level(faces, operator, region[rows], rows, parts.landmarks)
    return HeadModel(
        name=parts.name,
        licence=parts.licence,
        source=parts.source,
        notice=parts.notice,
        sha256=sha256,
        subjects=dict(parts.subjects),
        mean=_frozen(np.asarray(parts.mean, np.float32)),
        modes=_frozen(np.asarray(parts.modes, np.float32)),
        sigma=_frozen(np.asarray(parts.sigma, np.float32)),
        landmarks=dict(parts.landmarks),
        levels=levels,
        figures=dict(parts.figures),
        scores=_frozen(np.asarray(parts.scores, np.float32)),
        expressions=Expressions(expressions.names, _frozen(np.asarray(expressions.shapes, np.float32))),
    )


def _level(
    faces: np.ndarray, operator: sparse.csr_array, region: np.ndarray, rows: np.ndarray, landmarks: Mapping[str, int]
) -> Level:
    place = {int(row): k for k, row in enumerate(rows)} if len(rows) < 30_000 else {v: v for v in landmarks.values()}
    return Level(
        faces=_frozen(np.asarray(faces, np.int32)),
        operator=operator,
        face_region=_frozen(np.asarray(region, bool)),
        boundary=_frozen(boundary_vertices(faces, row_count(operator))),
        landmarks={name: place[v] for name, v in landmarks.items() if v in place},
        rows=_frozen(np.asarray(rows, np.int32)),
    )


def _frozen(array: np.ndarray) -> np.ndarray:
    array = array.view()
    array.flags.writeable = False
    return array


def load_model(name_or_path: str | Path = "default") -> HeadModel:
    """Loads a head model by its name (shipped with the program, or in the user's folder) or from a file. Raises
    UnknownModel or BadModel."""
    parts, sha256 = read_parts(model_path(name_or_path))
    return assemble(parts, sha256)


def with_modes(model: HeadModel, count: int) -> HeadModel:
    """Returns the model reduced to its first ``count`` modes."""
    posed = range(min(model.posed.start, count), min(model.posed.stop, count))
    return replace(
        model,
        modes=model.modes[:count],
        sigma=model.sigma[:count],
        scores=model.scores[:, :count],
        posed=posed,
        _bases={},
    )


def with_expressions(model: HeadModel) -> HeadModel:
    """Returns the model with its expressions appended as modes, whose coefficients are the expression weights. A model
    without expressions, or with expressions already appended, is returned unchanged."""
    count = len(model.expressions)
    if not count or len(model.posed):
        return model
    shapes = model.expressions.shapes
    return replace(
        model,
        modes=np.concatenate([model.modes, shapes]),
        sigma=np.concatenate([model.sigma, np.linalg.norm(shapes.reshape(count, -1), axis=1)]),
        posed=range(len(model.modes), len(model.modes) + count),
        _bases={},
    )


def model_info(model: HeadModel) -> dict[str, Any]:
    """Returns a description of the model that can be written as JSON. ``vertices`` and ``faces`` are counts of the
    finest mesh; quality figures that were not measured are None."""
    full = model.levels["full"]
    return {
        "name": model.name,
        "licence": model.licence,
        "sha256": model.sha256,
        "subjects": dict(model.subjects),
        "modes": len(model.modes),
        "expressions": list(model.expressions.names),
        "vertices": full.count,
        "faces": len(full.faces),
        "landmarks": len(model.landmarks),
        "generalisation_mm": model.figures.get("generalisation_mm"),
        "specificity_mm": model.figures.get("specificity_mm"),
        "source": model.source,
        "notice": model.notice,
        "figures": dict(model.figures),
        "levels": {
            name: {"vertices": level.count, "faces": len(level.faces)} for name, level in sorted(model.levels.items())
        },
    }
