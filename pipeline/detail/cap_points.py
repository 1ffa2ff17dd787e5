"""Turns points measured on a thin cap into points of the skin under it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.detail.surface_points import SurfacePoints
from pipeline.part_labels.cap import Cap
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import part_shares, vote_parts
from pipeline.stereo.depth_map import DepthMap
from rig.rig import Rig

MOSTLY = 0.7  # of the views that show a place, from which on it is the cap's
FOLDS_MM = 0.3  # how far a cap lies off the skin beyond its thickness, standard deviation


def skin_under_cap(points: SurfacePoints, depth_maps: Sequence[DepthMap], cap: Cap, rig: Rig) -> SurfacePoints:
    """Moves the points that show the cap inwards by its thickness, and counts them as skin.

    ``points``: of the visible surface, world, mm, with outward normals. ``depth_maps``: of which they come. ``cap``:
    the pixels that show it. ``rig``: the cameras as calibrated.
    """
    worn = {
        name: PartMap(name, np.zeros((*shown.shape, 3), np.uint8)).with_clothes(shown)
        for name, shown in cap.masks.items()
    }
    votes = vote_parts(depth_maps, worn, rig)
    if votes is None or not len(points.points):
        return points
    share = part_shares(votes, points.points)[:, Part.CLOTHES.channel]
    on_cap = (points.part == Part.CLOTHES) & (share > MOSTLY)
    moved = points.points - np.where(on_cap, cap.thickness_mm, 0.0)[:, None] * points.normals
    return replace(
        points,
        points=moved,
        deviation_mm=np.where(on_cap, np.hypot(points.deviation_mm, FOLDS_MM), points.deviation_mm),
        part=np.where(on_cap, np.uint8(Part.SKIN), points.part),
    )
