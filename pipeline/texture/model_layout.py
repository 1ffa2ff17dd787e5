"""The layout that belongs to a head model: made once, kept by the model's content, and mapped by every later process."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from pipeline.eigenheads.model import HeadModel
from pipeline.kept_arrays import kept_arrays
from pipeline.texture.inpaint import neighbours
from pipeline.texture.uv_unwrap import Layout, unwrap
from pipeline.texture.view_selection import Neighbourhood


@dataclass(frozen=True, slots=True, eq=False)
class ModelLayout:
    """Of the model's full level."""

    layout: Layout
    around: Neighbourhood


def model_layout(model: HeadModel) -> ModelLayout:
    """Raises NoLayout for a model whose surface is not one piece with one open border."""
    return _kept(model.mean.tobytes(), model)


@lru_cache(maxsize=4)
def _by_content(key: bytes) -> dict[str, ModelLayout]:
    return {}


def _kept(key: bytes, model: HeadModel) -> ModelLayout:
    known = _by_content(key)
    faces = model.levels["full"].faces
    if "made" not in known:

        def make() -> dict[str, np.ndarray]:
            found = unwrap(model.vertices(np.zeros(0)), faces)
            around = Neighbourhood.of(*neighbours(faces, len(found.uv) and int(faces.max()) + 1))
            return {
                "uv": found.uv,
                "faces": found.faces.astype(np.int32),
                "source": found.source.astype(np.int32),
                "starts": around.starts,
                "indices": around.indices,
                "opposite": around.opposite,
            }

        kept = kept_arrays("uv-layout", (model.mean, faces), make, made_by=(unwrap, neighbours, Neighbourhood))
        known["made"] = ModelLayout(
            Layout(kept["uv"], kept["faces"], kept["source"]),
            Neighbourhood(kept["starts"], kept["indices"], kept["opposite"]),
        )
    return known["made"]
