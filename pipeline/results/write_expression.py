"""Writes ``neutral.glb`` and ``posed.glb`` of a result: the head without its expression, and the head with morph
targets for other expressions."""

from pathlib import Path

import numpy as np

from pipeline.evidence.expression import BlendshapeRig
from pipeline.results.reconstruction import Reconstruction
from rig.atomic_write import write_atomically
from rig.formats.meshes.glb import glb_bytes
from rig.formats.meshes.morph_glb import with_morphs
from rig.geometry import RigidTransform
from rig.mesh import Mesh


def write_expression(folder: Path, result: Reconstruction, blendshape_rig: BlendshapeRig) -> None:
    """Writes ``neutral.glb`` and ``posed.glb`` if the settings ask for them, with the vertex colours of the
    photographed head."""
    place, outputs = result.head.fit.world_from_head, result.settings.outputs
    head_from_world = RigidTransform(place.rotation, place.translation).inverse()
    neutral = Mesh(
        head_from_world.apply(blendshape_rig.neutral_world.vertices),
        blendshape_rig.neutral_world.faces,
        result.texturing.vertices.colours,
    )
    glb = glb_bytes(neutral, normals=neutral.normals(), colours=np.asarray(result.texturing.vertices.colours))
    if outputs.neutral:
        write_atomically(folder / "neutral.glb", glb)
    if outputs.morphs:
        morphed = with_morphs(glb, neutral.vertices, neutral.faces, blendshape_rig.morphs, blendshape_rig.weights)
        write_atomically(folder / "posed.glb", morphed)
