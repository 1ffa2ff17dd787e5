"""Reduces a head's texture layout to fewer triangles, whose lost detail a normal map restores.

The mesh of the layout is decimated with its border fixed: both sides of the cut keep the same vertices, so that no gap
opens, and the texture stays where it is. It is computed once from a model's mean head, and cached.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.compute.array_cache import cached_arrays
from pipeline.head_model.decimation import decimate
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import boundary_vertices
from pipeline.texturing.layout.uv_unwrap import Layout, unwrap

FACES = 10_000  # what games give a head; 1,100 of a model of 22,000 left lids too few
FACE_WEIGHT = 8.0  # of an error in the face region


@dataclass(frozen=True, slots=True, eq=False)
class ReducedLayout:
    """Holds a texture layout reduced to fewer triangles. ``rows`` are the vertices of the full layout that remain,
    ``faces`` the triangles as indices into ``rows``."""

    rows: Int[np.ndarray, " n"]
    faces: Int[np.ndarray, "f 3"]


def reduced_layout(model: HeadModel, layout: Layout) -> ReducedLayout:
    """Returns the reduced texture layout of a model's full level, computed once from its mean head and cached."""
    mean, region = model.vertices(np.zeros(0)), model.levels["full"].face_region

    def make() -> dict[str, np.ndarray]:
        found = reduce(layout, mean, np.where(region, FACE_WEIGHT, 1.0))
        return {"rows": found.rows.astype(np.int32), "faces": found.faces.astype(np.int32)}

    inputs = (model.mean, layout.faces, region, FACES)
    kept = cached_arrays("reduced-layout", inputs, make, made_by=(reduce, decimate, boundary_vertices, unwrap))
    return ReducedLayout(kept["rows"], kept["faces"])


def reduce(
    layout: Layout, vertices: Float[np.ndarray, "v 3"], importance: Float[np.ndarray, " v"], count: int = FACES
) -> ReducedLayout:
    """Reduces the texture layout of a mesh to ``count`` triangles or a few more; its border stays unchanged.
    ``importance`` multiplies the error of each vertex: the layout stays denser where it is high."""
    source = layout.source
    ((rows, faces),) = decimate(
        vertices[source],
        layout.faces,
        (min(count, len(layout.faces)),),
        importance=importance[source],
        fixed=boundary_vertices(layout.faces, len(source)),
        chart=layout.uv,
    )
    return ReducedLayout(rows, faces)
