"""Converts the depth maps to one cloud of surface points with normals; each point has a part label (skin, hair or
clothes)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.detail.surface_points_kernels import cell_numbers, mean_points
from pipeline.fusion.view_stack import ALONE_FACTOR, VIEWS_SURE
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.part_labels.cap import Cap
from pipeline.part_labels.codes import Part, codes_from_channels
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, part_shares, vote_parts
from pipeline.stereo.depth_map import DepthMap, points_world
from rig.camera import Camera
from rig.mesh import Mesh, vertex_normals
from rig.rig import Rig

MOSTLY = 0.7  # of the views that show a place, from which on it is the cap's
FOLDS_MM = 0.3  # how far a cap lies off the skin beyond its thickness, standard deviation
CELL_MM = 0.8  # points nearer than that become one: three quarters of a pixel of the usual rig
MAX_VIEWS_NEEDED = 4  # views that agree on a point, at most: with fewer, points beside hair lie 1 mm too deep
HAIR_OFF_MM = 0.5  # how far beside the skin a point lies that is hair after all
MIN_FACING = 0.35  # cosine between a point's normal and its view: flatter windows smear
INSIDE_MM = 4.0  # farther behind the fitted head a point shows something that neither pulls nor bounds it
EVERY = 4  # vertices of the head stand for the others
TOGETHER_DEG = 65.0  # between views that may see one place: the dense stage compares no others


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Holds n points of the visible surface in the world frame, each with its normal, its standard deviation, and its
    part label."""

    points: Float[np.ndarray, "n 3"]  # mm
    normals: Float[np.ndarray, "n 3"]  # unit, outwards
    deviation_mm: Float[np.ndarray, " n"]  # along the normal
    part: UInt8[np.ndarray, " n"]  # codes of ``Part``

    def chosen(self, rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> "SurfacePoints":
        """Returns the surface points with the indices ``rows``."""
        return SurfacePoints(self.points[rows], self.normals[rows], self.deviation_mm[rows], self.part[rows])


def thin(surface: SurfacePoints, cell_mm: float) -> SurfacePoints:
    """Replaces the points in each cell of a grid that have the same part and main direction of the normal by their
    mean, weighted by information.

    The standard deviation remains that of a single point, because neighbouring points come from overlapping windows and
    have nearly the same error.

    Args:
        surface: points, mm.
        cell_mm: edge of a cell.

    Returns:
        The mean points, in the order of the cells.
    """
    if not len(surface.points):
        return surface
    points, normals, deviation = (
        np.ascontiguousarray(each, float) for each in (surface.points, surface.normals, surface.deviation_mm)
    )
    part = np.ascontiguousarray(surface.part)
    numbers, group = np.unique(cell_numbers(points, normals, part, cell_mm), return_inverse=True)
    return SurfacePoints(*mean_points(group, len(numbers), points, normals, deviation, part))


@traced
def dense_points(depth_maps: Sequence[DepthMap], votes: PartVotes | None, head_world: Mesh) -> SurfacePoints:
    """Returns the surface points on which enough views agree. The points are thinned to one for each grid cell, part
    label and main direction of the normal.

    Args:
        depth_maps: one for each view.
        votes: which part each point shows.
        head_world: the fitted head.

    Returns:
        The points, in the order of their cells; no points without depth maps or votes.
    """
    views_needed = count_views_needed([each.camera for each in depth_maps], head_world.vertices.mean(axis=0))
    clouds = map_in_threads(lambda k: _cloud(depth_maps[k], views_needed), len(depth_maps))
    if not clouds or votes is None:
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.uint8))
    points, normals, deviation = (np.concatenate(column) for column in zip(*clouds, strict=True))
    # A million pixels, a tenth of that in cells.
    cells = thin(SurfacePoints(points, normals, deviation, np.zeros(len(points), np.uint8)), CELL_MM)
    share = part_shares(votes, cells.points)
    part = codes_from_channels(share.argmax(axis=1))
    # What may be hair may lie where hair does: the deviation of both together.
    skin = share[:, Part.SKIN.channel]
    doubt = np.where(part == Part.SKIN, 1.0 - skin / np.maximum(share.sum(axis=1), 1e-9), 0.0)
    deviation = np.sqrt(cells.deviation_mm**2 + doubt * HAIR_OFF_MM**2)
    part[_behind(cells.points, head_world)] = Part.HAIR  # it bounds nothing there and pulls nothing
    return replace(cells, deviation_mm=deviation, part=part)


def count_views_needed(cameras: Sequence[Camera], at_world: Float[np.ndarray, " 3"]) -> int:
    """Returns how many views must agree on a point near the head. The number is half of the largest number of cameras
    within ``TOGETHER_DEG`` of each other, but at least two and at most ``MAX_VIEWS_NEEDED``.

    Args:
        cameras: of the depth maps.
        at_world: about the middle of the head, mm.
    """
    towards = np.array([camera.centre_world for camera in cameras]).reshape(-1, 3) - at_world
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    together = (towards @ towards.T > np.cos(np.radians(TOGETHER_DEG))).sum(axis=1)
    return min(max(int(together.max(initial=0)) // 2, 2), MAX_VIEWS_NEEDED)


def _behind(points: Float[np.ndarray, "n 3"], head_world: Mesh) -> np.ndarray:
    vertices = head_world.vertices[::EVERY]
    normals = vertex_normals(head_world.vertices, head_world.faces)[::EVERY]
    _, near = nearest(PointTree.of(vertices), points)
    return ((points - vertices[near]) * normals[near]).sum(axis=1) < -INSIDE_MM


def _cloud(
    depth_map: DepthMap, views_needed: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    known, camera = depth_map.known, depth_map.camera
    points, normals = points_world(depth_map), depth_map.normal[known].astype(float)
    towards = camera.centre_world - points
    facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    views = depth_map.views[known]
    kept = (views >= views_needed) & (facing >= MIN_FACING)
    deviation = depth_map.deviation_mm[known][kept] * facing[kept]  # along the ray, to along the normal
    deviation *= np.where(views[kept] < VIEWS_SURE, ALONE_FACTOR, 1.0)
    return points[kept], normals[kept], deviation


def skin_under_cap(points: SurfacePoints, depth_maps: Sequence[DepthMap], cap: Cap, rig: Rig) -> SurfacePoints:
    """Moves the points on a swim or wig cap inwards by the cap's thickness, and labels them as skin.

    ``points``: points of the visible surface (world, mm) with outward normals. ``depth_maps``: the maps from which the
    points come. ``cap``: thickness of the cap, and its pixels. ``rig``: the cameras as calibrated.
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
