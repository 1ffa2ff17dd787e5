"""Paints the texture of a result's head, if the settings ask for a file that has one."""

import numpy as np
from jaxtyping import Bool

from pipeline.compute.trace import traced
from pipeline.head_model.model import HeadModel
from pipeline.settings import Settings
from pipeline.texturing.layout.model_layout import ModelLayout, model_layout
from pipeline.texturing.layout.uv_unwrap import Atlas, NoLayout
from pipeline.texturing.paint import paint_texture, texture_size
from pipeline.texturing.vertex_colours import Texture
from pipeline.warnings import ReportWarning
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.rig import Rig


def find_layout(model: HeadModel, settings: Settings) -> tuple[ModelLayout | None, list[ReportWarning]]:
    """Returns the model's texture layout; None if no file of the result has a texture, or if the model cannot be laid
    flat. Also returns warnings about the model."""
    if not settings.outputs.textured or settings.texture.blend == "reference":
        return None, []
    try:
        return model_layout(model), []
    except NoLayout as reason:
        return None, [compose("no-texture-layout", reason=reason.message)]


@traced
def paint_head(
    layout: ModelLayout | None,
    mesh: Mesh,
    coloured: Texture,
    face_region: Bool[np.ndarray, " v"],
    settings: Settings,
    full_size: Rig | None = None,
) -> Atlas | None:
    """Paints the texture of the head, as fine as the pictures, or as those of the cameras ``full_size``. Returns None
    if there is no layout or no camera saw the head."""
    if layout is None or coloured.decision is None:
        return None
    region = np.flatnonzero(face_region)
    wanted = settings.outputs.texture_size
    size = texture_size(layout.layout, mesh, full_size or coloured.decision.views, region, wanted=wanted)
    return paint_texture(layout.layout, mesh, coloured.colours, coloured.decision, size)
