"""Closes a head for 3D printing and stands it on its neck."""

import numpy as np

from pipeline.head_model.subdivision import boundary_loops, close_loop
from rig.mesh import Mesh

FAN_MM = 15.0  # a border that reaches so far to all sides is the neck's: it is closed by a fan about its middle


def printable(head: Mesh) -> Mesh:
    """Returns the head (head frame, mm) as a closed mesh for printing: z up, standing on z = 0.

    The neck is closed by triangles around the middle of its border; open lids and lips are closed by a strip from
    corner to corner. Raises NotAManifold if a border touches itself.
    """
    vertices, added = [head.vertices], [head.faces]
    count = len(head.vertices)
    for loop in boundary_loops(head.faces):
        border = head.vertices[loop]
        if np.ptp(border, axis=0).min() < FAN_MM and np.ptp(border[:, [0, 2]], axis=0).min() < 2 * FAN_MM:
            added.append(close_loop(head.vertices, loop))
            continue
        ring = np.array(loop)
        added.append(np.stack([np.roll(ring, -1), ring, np.full(len(ring), count)], axis=1).astype(np.int32))
        vertices.append(border.mean(axis=0, keepdims=True))
        count += 1
    points = np.concatenate(vertices)[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    points[:, 2] -= points[:, 2].min()
    return Mesh(points, np.concatenate(added))
