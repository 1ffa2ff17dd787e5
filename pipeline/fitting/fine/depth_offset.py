"""What all points of depth maps err alike, taken off before the head is drawn to them.

Windows that match two and two lie 0.07 to 0.15 mm too deep all over the face, whatever its texture; a fit that solved
cameras and shape together has its mean within 0.03 mm of the truth (measured on two captures that another program
rendered). What the two differ by in the median belongs to the depth; what differs from place to place is shape.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from pipeline.dense.part_votes import SKIN
from pipeline.fitting.fine.association import associate, interpolated
from pipeline.fitting.fine.surface_points import SurfacePoints, thinned
from rig.mesh import Mesh

CELL_MM, REACH_MM, AGREEMENT, LEAST_POINTS = 2.0, 2.0, 0.8, 300
MOST_MM = 0.3


def without_common_offset(surface: SurfacePoints, head_world: Mesh, face: Bool[np.ndarray, " v"]) -> SurfacePoints:
    """The points moved along their normals by what they and the fitted face differ by in the median.

    Args:
        surface: of depth maps, world frame, mm.
        head_world: the fitted head.
        face: its vertices that tell.

    Returns:
        The points, at most 0.3 mm from where they were; unchanged where too few of them show the face.
    """
    skin = thinned(surface.chosen(surface.part == SKIN), CELL_MM)
    if len(skin.points) < LEAST_POINTS:
        return surface
    vertices, faces, normals = head_world.vertices, head_world.faces, head_world.normals()
    found = associate(skin.points, skin.normals, vertices, normals, faces, reach_mm=REACH_MM, least_agreement=AGREEMENT)
    corner = faces[found.triangle]
    on_face = face[corner].all(axis=1)
    if np.count_nonzero(on_face) < LEAST_POINTS:
        return surface
    ahead = interpolated(normals[corner], found.blend)
    off = ((skin.points[found.row] - interpolated(vertices[corner], found.blend)) * ahead).sum(axis=1)
    common_mm = float(np.clip(np.median(off[on_face]), -MOST_MM, MOST_MM))
    return replace(surface, points=surface.points - common_mm * surface.normals)
