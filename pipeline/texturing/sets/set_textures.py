"""Paints a texture of every set, from the views that the photographs chose.

Weights and chosen views are those of the head's texture, so that a texel of any set shows the same pixel of the same
camera. Only what depends on the set's own light is estimated anew: the cameras' gains, the agreed colours and the
corrections at seams.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.geometry.projection import project_points
from pipeline.imaging.colour_balance import balance
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import TextureSettings
from pipeline.texturing.decision import Decision, pack_pictures
from pipeline.texturing.inpaint import fill_unknown
from pipeline.texturing.layout.model_layout import ModelLayout
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.seam_levelling import level_views
from pipeline.texturing.vertex_colours_kernels import OUTLIER, blend_views
from pipeline.texturing.visibility import FOOTPRINT_PX, LINEAR, sharpened
from pipeline.texturing.visibility_kernels import sample_colours
from rig.colour_space import srgb_from_linear
from rig.image import ImageRgb
from rig.mesh import Mesh

MAX_SIZE = 4096  # sets are read at work size, whose pixels no finer texels are worth


@traced
def set_texture(
    images: Mapping[str, ImageRgb],
    decision: Decision,
    mesh_world: Mesh,
    silhouettes: Mapping[str, Silhouette],
    layout: ModelLayout,
    *,
    size: int,
    settings: TextureSettings,
) -> tuple[Atlas, Float[np.ndarray, "k 3"]]:
    """Paints the texture of one set. Also returns the gain of each camera and channel (k, 3).

    Args:
        images: of the set, by camera.
        decision: which views colour each vertex.
        mesh_world: the head, mm.
        silhouettes: by camera.
        layout: of the head, with its edges.
        size: of the texture, texels.
        settings: of the texture.
    """
    views, weights = decision.views, decision.weights

    def read(k: int) -> tuple[UInt8[np.ndarray, "_ _ 3"], Float32[np.ndarray, "v 3"]]:
        name = views.names[k]
        image = sharpened(images[name], silhouettes[name].mask, settings.sharpening)
        pixels = project_points(views.cameras[k], mesh_world.vertices)
        return image, sample_colours(image, pixels, weights[k], LINEAR, FOOTPRINT_PX)

    found = map_in_threads(read, len(views))
    colours = np.stack([seen for _, seen in found])
    gains, offsets = np.ones((len(views), 3)), np.zeros((len(views), 3))
    if settings.balance:
        gains, offsets = balance(weights, colours)
    balanced = np.ascontiguousarray(colours * gains[:, None] + offsets[:, None], np.float32)
    agreed, seen = blend_views(weights, balanced, OUTLIER)
    codes, level_to = (
        np.float32(255) * srgb_from_linear(np.clip(of, 0, 1)).astype(np.float32) for of in (balanced, agreed)
    )
    fields = level_views(weights, codes, level_to, layout.around)
    masks = {name: silhouettes[name].mask for name in views.names}
    pictures = pack_pictures(
        views, [image for image, _ in found], masks, gains, offsets, mesh_world=mesh_world,
    )  # fmt: skip
    corrections = fields[np.maximum(decision.slots, 0), np.arange(len(decision.slots))[:, None]]
    chosen = replace(decision, corrections=corrections, pictures=pictures)
    filled = srgb_from_linear(np.clip(fill_unknown(agreed, seen > 0, mesh_world.faces), 0, 1))
    shown = np.rint(255 * filled).astype(np.uint8)
    return paint_texture(layout.layout, mesh_world, shown, chosen, size), gains
