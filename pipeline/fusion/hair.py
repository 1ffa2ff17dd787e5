"""Decides what counts as hair, and makes the surface of hair and clothes as smooth as pictures resolve it.

Two cameras see other strands and other threads, so that windows match chance patterns: what depth says of them scatters
over millimetres and leaves gravel with pockets and handles. That is noise, not relief. Its votes are therefore weak in
the signed distance (``firmness``), which leaves no pockets, and its vertices take the mean of those about them.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.trace import traced
from pipeline.fusion.quality import EDGE_MM, guessed_deviation_mm
from pipeline.fusion.refinement import neighbours
from pipeline.fusion.refinement_kernels import blurred_over_mesh
from pipeline.fusion.skin import skin_share
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.part_labels.codes import Part
from pipeline.part_labels.votes import PartVotes
from rig.mesh import Mesh, face_normals

# Height (mm) over the head up to which hair is skin with hair's colour (stubble, brows, a beard), and from which on it
# is hair: what depth shows of beard-smile's beard lies 0.7 mm over the head, and of its hair 3.6.
STUBBLE_MM = (1.0, 3.0)
CELLS = 64  # about a cell, whose mean height counts: 12 mm about it
RESOLVED_MM = 4.0  # standard deviation of the mean that a vertex of hair and clothes takes: gravel is 2 to 5 mm wide
STEP_SHARE = 0.46  # variance of one step of a mean, by the area of a vertex
OFF_HEAD_MM = 8.0  # from the head there is no skin: strands that hang before it have skin's colours in shade


def parts_over_head(votes: PartVotes, head_world: Mesh) -> PartVotes:
    """Returns the votes with the cells' heights over a head considered: hair that lies on its skin counts as skin, and
    skin that lies off it as hair."""
    skin, hair = Part.SKIN.channel, Part.HAIR.channel
    both, out = votes.probability[:, skin] + votes.probability[:, hair], votes.probability.copy()
    far, near = nearest(PointTree.of(head_world.vertices), votes.places)
    height = ((votes.places - head_world.vertices[near]) * head_world.normals()[near]).sum(axis=1)
    alike = nearest(PointTree.of(votes.places), votes.places, count=min(CELLS, len(height)))[1]
    weight = out[alike, hair] + 1e-9
    mean_mm = (weight * height[alike]).sum(axis=1) / weight.sum(axis=1)
    over = np.clip((mean_mm - STUBBLE_MM[0]) / (STUBBLE_MM[1] - STUBBLE_MM[0]), 0.0, 1.0)
    out[:, hair] = np.where(far > OFF_HEAD_MM, both, over * out[:, hair])
    out[:, skin] = both - out[:, hair]
    return replace(votes, probability=out)


@traced
def smooth_hair(mesh_world: Mesh, skin: Float[np.ndarray, " v"], seen: Bool[np.ndarray, " v"]) -> Mesh:
    """Returns the mesh with its vertices moved to the mean of their surroundings, as far as they are not skin.

    Args:
        mesh_world: closed, mm.
        skin: probability that a vertex shows skin.
        seen: by a view; the others are what is seen next to them.
    """
    beside = neighbours(mesh_world.faces, len(seen))
    share = skin_share(beside, mesh_world.vertices, skin, seen)
    share = (share * EDGE_MM / np.maximum(guessed_deviation_mm(mesh_world.vertices, seen), EDGE_MM))[:, None]
    area_mm2 = 0.5 * np.linalg.norm(face_normals(mesh_world.vertices, mesh_world.faces), axis=1).sum() / len(seen)
    mean = blurred_over_mesh(mesh_world.vertices, *beside, round(RESOLVED_MM**2 / (STEP_SHARE * area_mm2)))
    return Mesh(share * mesh_world.vertices + (1.0 - share) * mean, mesh_world.faces)
