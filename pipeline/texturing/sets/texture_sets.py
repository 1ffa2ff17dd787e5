"""Paints a texture of the head from each further set of photographs in the capture.

Weights and chosen views are the same as in the head's main texture, so a texel shows the same pixel of the same camera
in all sets. Only values that depend on the set's light are estimated again: the cameras' gains, the mean colours and
the seam corrections.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.geometry.projection import project_points
from pipeline.imaging.colour_balance import balance
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import TextureSettings
from pipeline.texturing.layout.uv_unwrap import Atlas, ModelLayout
from pipeline.texturing.neighbourhood import fill_unknown, level_views
from pipeline.texturing.paint import paint_texture
from pipeline.texturing.sets.specular import Specular, specular_light
from pipeline.texturing.view_selection_kernels import OUTLIER, blend_views, sample_colours
from pipeline.texturing.visibility import FOOTPRINT_PX, LINEAR, Decision, pack_pictures, sharpen
from pipeline.warnings import ReportWarning
from rig.colour_space import srgb_from_linear
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

MAX_SIZE = 4096  # sets are read at work size, whose pixels no finer texels are worth

CROSS, PARALLEL = "cross", "parallel"  # names of the sets in polarised light


@dataclass(frozen=True, slots=True, eq=False)
class SetTextures:
    """Holds a texture for each set of photographs, with the UV layout of the head. ``specular`` is None unless crossed
    and parallel polarised pictures exist."""

    atlases: Mapping[str, Atlas]
    specular: Specular | None

    @property
    def diffuse(self) -> Atlas | None:
        """Returns the texture of the diffuse reflection; None without pictures in crossed polarised light."""
        return self.atlases.get(CROSS)


def colour_by_sets(
    sets: Mapping[str, Mapping[str, ImageRgb]],
    decision: Decision | None,
    mesh_world: Mesh,
    silhouettes: Mapping[str, Silhouette],
    layout: ModelLayout | None,
    *,
    atlas: Atlas | None,
    settings: TextureSettings,
) -> tuple[SetTextures | None, list[ReportWarning]]:
    """Paints a texture from each set of photographs. Sets in polarised light also give the specular reflection.

    Args:
        sets: pictures by set and camera.
        decision: which views colour each vertex.
        mesh_world: the head, mm.
        silhouettes: by camera.
        layout: of the head.
        atlas: the head's texture, whose size these get, up to ``MAX_SIZE``.
        settings: of the texture.

    Returns:
        The textures and warnings. The textures are None without sets, or if the head has no texture.
    """
    if not sets:
        return None, []
    if decision is None or layout is None or atlas is None:
        return None, [compose("texture-sets-unused", sets=[*sets])]
    size = min(len(atlas.image), MAX_SIZE)
    painted = {
        name: set_texture(images, decision, mesh_world, silhouettes, layout, size=size, settings=settings)
        for name, images in sets.items()
    }
    specular = None
    if CROSS in sets and PARALLEL in sets:
        gains = painted[CROSS][1]
        specular = specular_light(sets[CROSS], sets[PARALLEL], gains, decision, silhouettes, layout.layout, size=size)
    warnings = [compose("texture-sets-exchanged")] if specular is not None and specular.exchanged else []
    return SetTextures({name: found for name, (found, _) in painted.items()}, specular), warnings


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
    """Paints a texture from one set of photographs; also returns the gain of each camera and channel (k, 3).

    ``images`` (of the set) and ``silhouettes`` are by camera. ``decision``: the views that colour each vertex.
    ``mesh_world``: the head (mm). ``size``: width of the texture in texels.
    """
    views, weights = decision.views, decision.weights

    def read(k: int) -> tuple[UInt8[np.ndarray, "_ _ 3"], Float32[np.ndarray, "v 3"]]:
        name = views.names[k]
        image = sharpen(images[name], silhouettes[name].mask, settings.sharpening)
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
