"""The dense stage's depth maps as one cloud of oriented points, each with what it shows.

What the middle of the fitted face shows is skin; what stands off the head above the chin is hair, below it clothes.
Their colours, as histograms over all views, say which of the three every other place is more like; places vote by
cells, since a pixel alone may be a freckle or a gap between strands.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from pipeline.dense.depth_map import DepthMap, points_world
from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.fine.surface_points import CLOTHES, HAIR, SKIN, SurfacePoints
from pipeline.fitting.photo.hair_mask import BINS, depth_in_face, histogram
from pipeline.settings import FineSettings
from rig.geometry import Similarity
from rig.mesh import Mesh, vertex_normals

BORDER_MM = 15.0  # of the face, where hair comes in
ODDS = 1.0  # log odds that a place must show to be no skin: most of a face and neck is
OFF_HEAD_MM = 8.0  # nearer than that a point may be skin: ears and neck of a fit are 5 mm off
INSIDE_MM = 4.0  # and farther behind the head it is nothing
VOTE_MM = 4.0  # edge of a cell
LEAST_POINTS = 2000  # of a part, to know what it looks like
FARTHEST_MM = 40.0  # from the head: beyond, looks of hair and clothes are not learned


@dataclass(frozen=True, slots=True, eq=False)
class HeadPlace:
    """The fitted head, and where on it things may be."""

    mesh: Mesh  # full level, world frame, mm
    middle: Bool[np.ndarray, " v"]  # surely skin: the face without its border, and nothing under hair
    chin: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]  # unit


def head_place(model: HeadModel, mesh: Mesh, world_from_head: Similarity) -> HeadPlace:
    """Of a fitted head. Surely skin is what lies between brows and jaw, well inside the face's border: fringes hang
    over foreheads."""
    mean = model.vertices(np.zeros(0))
    below_brows = mean[:, 1] < mean[model.landmarks["nasion"], 1]
    middle = (depth_in_face(model) > BORDER_MM) & below_brows
    return HeadPlace(mesh, middle, mesh.vertices[model.landmarks["gnathion"]], world_from_head.rotation[:, 1])


def dense_points(depth_maps: tuple[DepthMap, ...], head: HeadPlace, settings: FineSettings) -> SurfacePoints:
    """Every place that enough views agree on, as a point with its part.

    Args:
        depth_maps: one a view.
        head: the fitted one.
        settings: how many views must agree, and how frontally.

    Returns:
        The points, in the order of the maps; none where there are no maps.
    """
    clouds = [_cloud(each, settings) for each in depth_maps]
    if not clouds:
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.uint8))
    points, normals, deviation, colours = (np.concatenate(column) for column in zip(*clouds, strict=True))
    return SurfacePoints(points, normals, deviation, parts_by_colour(points, colours, head))


def _cloud(
    depth_map: DepthMap, settings: FineSettings
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], UInt8[np.ndarray, "n 3"]]:
    known, camera = depth_map.known, depth_map.camera
    points, normals = points_world(depth_map), depth_map.normal[known].astype(float)
    towards = camera.centre_world - points
    facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    kept = (depth_map.views[known] >= settings.views_least) & (facing >= settings.facing_least)
    deviation = depth_map.deviation_mm[known][kept] * facing[kept]  # along the ray, to along the normal
    return points[kept], normals[kept], deviation, depth_map.colour[known][kept]


def parts_by_colour(
    points: Float[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"], head: HeadPlace
) -> UInt8[np.ndarray, " n"]:
    """SKIN, HAIR or CLOTHES for every point, by place and colour."""
    group, places = _cells(points)
    distance, near = KDTree(head.mesh.vertices).query(places, distance_upper_bound=FARTHEST_MM)
    far = ~np.isfinite(distance)
    near = np.where(far, 0, near)
    normals = vertex_normals(head.mesh.vertices, head.mesh.faces)
    height = ((places - head.mesh.vertices[near]) * normals[near]).sum(axis=1)
    below = (places - head.chin) @ head.up < 0.0
    off = far | (height > OFF_HEAD_MM)
    skin = head.middle[near] & ~off & (np.abs(height) < 0.5 * OFF_HEAD_MM)
    samples = {SKIN: skin, HAIR: off & ~far & ~below, CLOTHES: off & ~far & below}
    part = np.where(off, np.where(below, CLOTHES, HAIR), SKIN).astype(np.uint8)
    odds = _log_odds(colours, group, samples)
    close = ~off & ~skin
    for other, side in ((HAIR, ~below), (CLOTHES, below)):
        if other in odds:
            part[close & side & (odds[other] > ODDS)] = other
    part[~off & (height < -INSIDE_MM)] = HAIR  # behind the skin: it bounds nothing and pulls nothing
    return part[group]


def _cells(points: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "g 3"]]:
    """The cell of every point, and the cells' mean places."""
    cell = np.floor((points - points.min(axis=0)) / VOTE_MM).astype(np.int64)
    size = cell.max(axis=0) + 1
    _, group = np.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True)
    count = np.bincount(group)
    return group, np.stack([np.bincount(group, points[:, k]) / count for k in range(3)], axis=1)


def _log_odds(
    colours: UInt8[np.ndarray, "n 3"], group: Int[np.ndarray, " n"], samples: dict[int, Bool[np.ndarray, " g"]]
) -> dict[int, Float[np.ndarray, " g"]]:
    """Mean log odds of each cell for hair and clothes against skin, where enough of both was seen."""
    shown = {part: colours[cells[group]] for part, cells in samples.items()}
    if len(shown[SKIN]) < LEAST_POINTS:
        return {}
    skin, bins = np.log(histogram(shown[SKIN])), tuple((colours // (256 // BINS)).T)
    count = np.bincount(group)
    return {
        part: np.bincount(group, (np.log(histogram(shown[part])) - skin)[bins]) / count
        for part in (HAIR, CLOTHES)
        if len(shown[part]) >= LEAST_POINTS
    }
