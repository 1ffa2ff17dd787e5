"""Computes the visual hull (figure 1): the largest body that casts the silhouettes. It serves as a comparison, and as a
start for the pose.

The value of a point is its largest signed distance over the views, in mm at its depth. The hull's surface is the zero
of that function, which uses sub-pixel contours as they are. It is computed on a coarse grid, and on the fine one only
where the surface can be. Naive surface nets (Gibson, *Constrained elastic surface nets*, 1998) make the mesh: a vertex
in every cell and a quadrilateral over every edge that the surface crosses. A hull, even from 50 views, has no eye
sockets and no philtrum; the paper shows it for that reason.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.geometry.projection import packed_camera
from pipeline.geometry.surface_nets import volume_net
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull_kernels import COARSE, carve_view, mark_occupied
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.geometry import nearest_to_rays
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.rig import Rig

Vector = Float[np.ndarray, " 3"]

SPACING_MM = 3.0
MIN_SHARE = 0.5  # of the views must see a point of the hull; where fewer look, anything could be


class NoHull(EigenheadError):
    """Reports silhouettes that have no common volume."""

    def __init__(self) -> None:
        super().__init__(compose("no-common-hull"))


def hull_extent(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Vector, float]:
    """Returns centre (world, mm) and edge length (mm) of a cube that contains the subject, as ``mask_extent`` of the
    usable silhouettes."""
    return mask_extent({camera.name: silhouettes[camera.name].mask for camera in _believed(silhouettes, rig)}, rig)


def mask_extent(masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig) -> tuple[Vector, float]:
    """Returns the centre (world, mm) and edge length (mm) of a cube that contains what the masks show. Masks may be
    smaller than the images.

    The centre is the point nearest to the rays through the masks' middles; the edge is the largest diagonal of a mask
    at that depth. Without any mask, the centre is the point that the cameras are directed at, and the edge 400 mm.
    """
    views, rays = [], []
    for name, mask in masks.items():
        camera = rig[name]
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        scale = camera.intrinsics.width / mask.shape[1]
        middle = np.array([[(columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2]])
        rays.append(camera.rays_world((middle + 0.5) * scale - 0.5)[0])
        views.append((camera, scale * np.hypot(np.ptp(rows), np.ptp(columns))))
    if not views:
        return rig.centre_world(), 400.0
    centre = nearest_to_rays(np.stack([camera.centre_world for camera, _ in views]), np.stack(rays))
    return centre, float(max(diagonal * depth_of(camera, centre) / camera.intrinsics.fx for camera, diagonal in views))


def depth_of(camera: Camera, point: Vector) -> float:
    """Returns the distance (mm) of a point along the camera's z axis, at least 1 mm."""
    return max(1.0, float(camera.camera_from_world.apply(point)[2]))


def visual_hull(
    silhouettes: Mapping[str, Silhouette], rig: Rig, *, spacing_mm: float = SPACING_MM, cells: int = 192
) -> Mesh:
    """Computes the visual hull of the usable silhouettes as a closed mesh (world, mm). Raises NoHull.

    The grid's nodes are about ``spacing_mm`` apart; farther if more than ``cells`` cells along a side were needed
    otherwise.
    """
    centre, edge = hull_extent(silhouettes, rig)
    views = _believed(silhouettes, rig)
    blocks = int(np.ceil(min(edge / spacing_mm, cells) / COARSE))
    field, step = _field(silhouettes, views, centre, edge, blocks)
    vertices, faces = volume_net(field)
    if not len(faces):
        raise NoHull
    corner = centre - edge / 2
    return Mesh(vertices.astype(float) * step + corner, faces)


def _believed(silhouettes: Mapping[str, Silhouette], rig: Rig) -> list[Camera]:
    """Returns the cameras whose silhouettes are usable and not empty."""
    return [
        c
        for c in rig
        if c.name in silhouettes and silhouettes[c.name].quality.usable and silhouettes[c.name].mask.any()
    ]


def _field(
    silhouettes: Mapping[str, Silhouette], cameras: list[Camera], centre: Vector, edge: float, blocks: int
) -> tuple[Float32[np.ndarray, "n n n"], float]:
    """Computes the signed distance (mm) on a grid with ``COARSE * blocks + 1`` points along each side, exact only near
    the surface. Also returns the grid's step (mm)."""
    corner, wide = centre - edge / 2, edge / blocks
    coarse = np.full((blocks + 1,) * 3, -np.inf, np.float32)
    votes = np.zeros(coarse.shape, np.int32)
    everywhere = np.ones((blocks,) * 3, bool)
    for camera in cameras:
        carve_view(coarse, votes, everywhere, 1, corner, wide, packed_camera(camera), silhouettes[camera.name].distance)
    _settle(coarse, votes, MIN_SHARE * len(cameras))
    # The field grows by at most a millimetre a millimetre (and a little: perspective), so that only blocks whose
    # corners are within their own diagonal of the surface can hold any of it.
    near = np.abs(coarse) < 1.2 * np.sqrt(3) * wide
    active = np.zeros((blocks,) * 3, bool)
    for offset in np.ndindex(2, 2, 2):
        active |= near[tuple(slice(o, o + blocks) for o in offset)]
    fine = _nearest_coarse(coarse)
    votes = np.zeros(fine.shape, np.int32)
    exact = np.full(fine.shape, -np.inf, np.float32)
    step = wide / COARSE
    for camera in cameras:
        carve_view(exact, votes, active, COARSE, corner, step, packed_camera(camera), silhouettes[camera.name].distance)
    _settle(exact, votes, MIN_SHARE * len(cameras))
    known = np.zeros(fine.shape, bool)
    mark_occupied(known, active)
    fine = np.where(known, exact, fine)
    for axis in range(3):  # a closed mesh, also where the images cut the subject off
        np.moveaxis(fine, axis, 0)[[0, -1]] = wide
    return fine, step


def _nearest_coarse(coarse: Float32[np.ndarray, "b b b"]) -> Float32[np.ndarray, "n n n"]:
    """Returns, at every fine point, the value of a coarse point beside it, of which only the sign is used."""
    index = np.arange(COARSE * (coarse.shape[0] - 1) + 1) // COARSE
    return coarse[np.ix_(index, index, index)]


def _settle(field: np.ndarray, votes: np.ndarray, least: float) -> None:
    """Marks, in place, points that too few views see as outside."""
    field[votes < max(2.0, least)] = np.float32(1e3)
