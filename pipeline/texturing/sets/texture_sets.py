"""Colours a head by the texture sets of its capture."""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import TextureSettings
from pipeline.texturing.decision import Decision
from pipeline.texturing.layout.model_layout import ModelLayout
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.sets.set_textures import MAX_SIZE, set_texture
from pipeline.texturing.sets.specular import Specular, specular_light
from pipeline.warnings import ReportWarning
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

CROSS, PARALLEL = "cross", "parallel"  # names of the sets in polarised light


@dataclass(frozen=True, slots=True, eq=False)
class SetTextures:
    """Holds the texture of each set, in the layout of the head's. ``specular`` is None unless there are both sets of
    polarised light."""

    atlases: Mapping[str, Atlas]
    specular: Specular | None

    @property
    def diffuse(self) -> Atlas | None:
        """Returns the texture of what the skin scatters, None without crossed pictures."""
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
    """Paints a texture of each set, and separates diffuse and specular light of those in polarised light.

    Args:
        sets: pictures by set and camera.
        decision: which views colour each vertex.
        mesh_world: the head, mm.
        silhouettes: by camera.
        layout: of the head.
        atlas: the head's texture, whose size these get, up to ``MAX_SIZE``.
        settings: of the texture.

    Returns:
        None without sets; None and a warning where the head has no texture.
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
