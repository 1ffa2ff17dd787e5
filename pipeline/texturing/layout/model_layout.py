"""Provides the texture layout of a head model: computed once, cached by the model's content, and memory-mapped by later
processes."""

from dataclasses import dataclass

import numpy as np

from pipeline.compute.array_cache import cached_arrays
from pipeline.head_model.model import HeadModel
from pipeline.texturing.layout.uv_unwrap import Layout, unwrap
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours


@dataclass(frozen=True, slots=True, eq=False)
class ModelLayout:
    """Holds the texture coordinates of a model's full level and which of its vertices are neighbours."""

    layout: Layout
    around: Neighbourhood


def model_layout(model: HeadModel) -> ModelLayout:
    """Returns the texture layout of a model. It is made from the model's mean head, so that texels of any two subjects
    correspond. Raises NoLayout for a surface that is not one piece with one open border."""
    faces = model.levels["full"].faces
    mean = model.vertices(np.zeros(0))

    def make() -> dict[str, np.ndarray]:
        found = unwrap(mean, faces)
        around = Neighbourhood.of(*neighbours(faces, len(mean)))
        return {
            "uv": found.uv,
            "faces": found.faces.astype(np.int32),
            "source": found.source.astype(np.int32),
            "starts": around.starts,
            "indices": around.indices,
            "opposite": around.opposite,
        }

    kept = cached_arrays("uv-layout", (model.mean, faces), make, made_by=(unwrap, neighbours, Neighbourhood))
    layout = Layout(kept["uv"], kept["faces"], kept["source"])
    return ModelLayout(layout, Neighbourhood(kept["starts"], kept["indices"], kept["opposite"]))
