"""Skin, hair or clothes, by where a vertex lies beside the fitted head: a first rule, for want of what pixels show."""

import numpy as np
from jaxtyping import UInt8
from scipy.spatial import KDTree

from pipeline.dense.surface.prior import near_rim
from rig.mesh import Mesh

UNSEEN, SKIN, HAIR, CLOTHES = 0, 1, 2, 3
PART_NAMES = ("unseen", "skin", "hair", "clothes")
SKIN_MM = 4.0  # from the fitted head: its own error, and half the distance of the vertices compared
EVERY = 4  # vertices of the head stand for the others


def parts_by_place(mesh: Mesh, views: UInt8[np.ndarray, " v"], head_world: Mesh | None) -> UInt8[np.ndarray, " v"]:
    """Unseen; skin near the fitted head; clothes beyond the rim of its neck; hair elsewhere. Without a head: skin."""
    part = np.where(views > 0, SKIN, UNSEEN).astype(np.uint8)
    if head_world is None:
        return part
    seen = np.flatnonzero(views > 0)
    chosen = np.arange(0, len(head_world.vertices), EVERY)
    tree = KDTree(head_world.vertices[chosen], balanced_tree=False, compact_nodes=False)
    far, near = tree.query(mesh.vertices[seen])
    away = far > SKIN_MM
    below = near_rim(head_world, head_world.vertices[chosen])[near]
    part[seen[away]] = np.where(below[away], CLOTHES, HAIR)
    return part
