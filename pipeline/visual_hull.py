"""The visual hull (figure 1): the largest body that casts the silhouettes. A comparison, and a start for the pose.

A point's value is its largest signed distance over the views, in mm at its depth, so that the hull's surface is the
zero level and sub-pixel contours are used as they are. The field is computed on a coarse grid, and on the fine one only
where the surface can be; naive surface nets (Gibson, *Constrained elastic surface nets*, 1998) make the mesh: a vertex
in every cell that the surface crosses, a quadrilateral over every edge that it crosses. A hull, even from 50 views, has
no eye sockets or philtrum; the paper shows it for that.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float32
from numba import njit

from pipeline.lens import distorted, packed_lens
from pipeline.silhouette import Silhouette
from rig.camera import Camera
from rig.errors import EigenheadError
from rig.layout import Rig
from rig.mesh import Mesh

COARSE = 4  # fine cells along the side of a coarse one
SPACING_MM = 3.0
LEAST_SHARE = 0.5  # of the views must see a point of the hull; where fewer look, anything could be


class NoHull(EigenheadError):
    """The silhouettes have no common body."""

    def __init__(self) -> None:
        super().__init__(
            "the silhouettes have no body in common: cameras.json does not belong to these images, or a mask is wrong"
        )


def hull_extent(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Float[np.ndarray, " 3"], float]:
    """``mask_extent`` of the usable silhouettes."""
    return mask_extent({camera.name: silhouettes[camera.name].mask for camera in _believed(silhouettes, rig)}, rig)


def mask_extent(masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig) -> tuple[Float[np.ndarray, " 3"], float]:
    """Centre (world, mm) and edge (mm) of a cube that holds what the masks show; they may be smaller than the images.

    The centre is where the rays through the masks' middles cross, the edge the largest mask's diagonal at that depth.
    Without a mask it is the place that the cameras look at, and 400 mm.
    """
    normal, right, views = 1e-9 * np.eye(3), np.zeros(3), []
    for name, mask in masks.items():
        camera = rig[name]
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        scale = camera.intrinsics.width / mask.shape[1]
        middle = np.array([[(columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2]])
        ray = camera.rays_world((middle + 0.5) * scale - 0.5)[0]
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ camera.centre_world
        views.append((camera, scale * np.hypot(np.ptp(rows), np.ptp(columns))))
    if not views:
        return rig.centre_world(), 400.0
    centre = np.linalg.solve(normal, right)
    return centre, float(max(diagonal * depth_of(camera, centre) / camera.intrinsics.fx for camera, diagonal in views))


def depth_of(camera: Camera, point: Float[np.ndarray, " 3"]) -> float:
    """Camera z of a point, at least 1 mm."""
    return max(1.0, float(camera.camera_from_world.apply(point)[2]))


def visual_hull(
    silhouettes: Mapping[str, Silhouette], rig: Rig, *, spacing_mm: float = SPACING_MM, cells: int = 192
) -> Mesh:
    """The hull of the usable silhouettes, closed, world frame, mm. Raises NoHull.

    ``cells`` a side at most: a larger subject gets a coarser grid.
    """
    centre, edge = hull_extent(silhouettes, rig)
    views = _believed(silhouettes, rig)
    blocks = int(np.ceil(min(edge / spacing_mm, cells) / COARSE))
    field, step = _field(silhouettes, views, centre, edge, blocks)
    vertices, faces = surface_net(field)
    if not len(faces):
        raise NoHull
    corner = centre - edge / 2
    return Mesh(vertices.astype(float) * step + corner, faces)


def _believed(silhouettes: Mapping[str, Silhouette], rig: Rig) -> list[Camera]:
    """The cameras whose silhouettes are usable and not empty."""
    return [
        c
        for c in rig
        if c.name in silhouettes and silhouettes[c.name].quality.usable and silhouettes[c.name].mask.any()
    ]


def _field(
    silhouettes: Mapping[str, Silhouette],
    cameras: list[Camera],
    centre: Float[np.ndarray, " 3"],
    edge: float,
    blocks: int,
) -> tuple[Float32[np.ndarray, "n n n"], float]:
    """Signed distance (mm) on a grid of ``COARSE * blocks + 1`` points a side, exact only near the surface."""
    corner, wide = centre - edge / 2, edge / blocks
    coarse = np.full((blocks + 1,) * 3, -np.inf, np.float32)
    votes = np.zeros(coarse.shape, np.int32)
    everywhere = np.ones((blocks,) * 3, bool)
    for camera in cameras:
        _add_view(
            coarse, votes, everywhere, 1, corner, wide, camera_parameters(camera), silhouettes[camera.name].distance
        )
    _settle(coarse, votes, LEAST_SHARE * len(cameras))
    # The field grows by at most a millimetre a millimetre (and a little: perspective), so that only blocks whose
    # corners are within their own diagonal of the surface can hold any of it.
    near = np.abs(coarse) < 1.2 * np.sqrt(3) * wide
    active = np.zeros((blocks,) * 3, bool)
    for offset in np.ndindex(2, 2, 2):
        active |= near[tuple(slice(o, o + blocks) for o in offset)]
    fine = _spread(coarse)
    votes = np.zeros(fine.shape, np.int32)
    exact = np.full(fine.shape, -np.inf, np.float32)
    step = wide / COARSE
    for camera in cameras:
        _add_view(
            exact, votes, active, COARSE, corner, step, camera_parameters(camera), silhouettes[camera.name].distance
        )
    _settle(exact, votes, LEAST_SHARE * len(cameras))
    known = np.zeros(fine.shape, bool)
    _mark(known, active)
    fine = np.where(known, exact, fine)
    for axis in range(3):  # a closed mesh, also where the images cut the subject off
        np.moveaxis(fine, axis, 0)[[0, -1]] = wide
    return fine, step


def _spread(coarse: Float32[np.ndarray, "b b b"]) -> Float32[np.ndarray, "n n n"]:
    """The nearest coarse value at every fine point: only its sign is used."""
    index = np.arange(COARSE * (coarse.shape[0] - 1) + 1) // COARSE
    return coarse[np.ix_(index, index, index)]


def _settle(field: np.ndarray, votes: np.ndarray, least: float) -> None:
    """Points that too few views see are outside."""
    field[votes < max(2.0, least)] = np.float32(1e3)


@njit(cache=True)
def _mark(known: np.ndarray, active: np.ndarray) -> None:
    for i, j, k in np.argwhere(active):
        known[
            i * COARSE : (i + 1) * COARSE + 1, j * COARSE : (j + 1) * COARSE + 1, k * COARSE : (k + 1) * COARSE + 1
        ] = True


def camera_parameters(camera: Camera) -> Float[np.ndarray, " 22"]:
    """Rotation, translation and ``packed_lens``, for compiled projections."""
    pose = camera.camera_from_world
    return np.concatenate([pose.rotation.ravel(), pose.translation, packed_lens(camera)])


@njit(cache=True, nogil=True)
def _add_view(
    field: np.ndarray,
    votes: np.ndarray,
    active: np.ndarray,
    split: int,
    corner: np.ndarray,
    step: float,
    p: np.ndarray,
    distance: np.ndarray,
) -> None:
    """Raises ``field`` to this view's distance (mm) at the points of the active blocks, and counts the view there."""
    height, width = distance.shape
    lens = p[12:]
    blocks = active.shape[0]
    for block in range(blocks * blocks * blocks):
        bi, bj, bk = block // (blocks * blocks), (block // blocks) % blocks, block % blocks
        if not active[bi, bj, bk]:
            continue
        # A block owns its low faces, and the outermost ones the high face too, so that no point is met twice ...
        for i in range(bi * split, (bi + 1) * split + 1):
            for j in range(bj * split, (bj + 1) * split + 1):
                for k in range(bk * split, (bk + 1) * split + 1):
                    # ... unless the block that owns it is not active.
                    if not _owner(i, j, k, split, bi, bj, bk, active):
                        continue
                    x, y, z = corner[0] + i * step, corner[1] + j * step, corner[2] + k * step
                    cz = p[6] * x + p[7] * y + p[8] * z + p[11]
                    if cz <= 1.0:
                        continue
                    u = (p[0] * x + p[1] * y + p[2] * z + p[9]) / cz
                    v = (p[3] * x + p[4] * y + p[5] * z + p[10]) / cz
                    column, row = distorted(u, v, lens)
                    if not (column >= 0 and row >= 0 and column < width - 1 and row < height - 1):
                        continue
                    c, r = int(column), int(row)
                    fx, fy = column - c, row - r
                    top = distance[r, c] + fx * (distance[r, c + 1] - distance[r, c])
                    low = distance[r + 1, c] + fx * (distance[r + 1, c + 1] - distance[r + 1, c])
                    value = np.float32((top + fy * (low - top)) * cz / p[12])
                    votes[i, j, k] += 1
                    if value > field[i, j, k]:
                        field[i, j, k] = value


@njit(cache=True, nogil=True, inline="always")
def _owner(i: int, j: int, k: int, split: int, bi: int, bj: int, bk: int, active: np.ndarray) -> bool:
    """Is (bi, bj, bk) the first active block, in index order, that the point belongs to?"""
    for a in range((i - 1) // split if i % split == 0 else i // split, i // split + 1):
        for b in range((j - 1) // split if j % split == 0 else j // split, j // split + 1):
            for c in range((k - 1) // split if k % split == 0 else k // split, k // split + 1):
                blocks = active.shape[0]
                if 0 <= a < blocks and 0 <= b < blocks and 0 <= c < blocks and active[a, b, c]:
                    return a == bi and b == bj and c == bk
    return False


@njit(cache=True)
def surface_net(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (float32, in grid steps) and triangles (int32, wound outwards) of the zero level; negative is inside."""
    nx, ny, nz = field.shape
    index = np.full((nx - 1, ny - 1, nz - 1), -1, np.int32)
    vertices = np.empty((nx * ny * nz // 8 + 1024, 3), np.float32)
    count = 0
    for i in range(nx - 1):
        for j in range(ny - 1):
            for k in range(nz - 1):
                total, x, y, z = 0, 0.0, 0.0, 0.0
                first = field[i, j, k] < 0
                mixed = False
                for a in range(2):
                    for b in range(2):
                        for c in range(2):
                            mixed = mixed or (field[i + a, j + b, k + c] < 0) != first
                if not mixed:
                    continue
                for axis in range(3):
                    for a in range(2):
                        for b in range(2):
                            di, dj, dk = (0, a, b) if axis == 0 else ((a, 0, b) if axis == 1 else (a, b, 0))
                            ei, ej, ek = di + (axis == 0), dj + (axis == 1), dk + (axis == 2)
                            low, high = field[i + di, j + dj, k + dk], field[i + ei, j + ej, k + ek]
                            if (low < 0) != (high < 0):
                                t = low / (low - high)
                                x += di + t * (ei - di)
                                y += dj + t * (ej - dj)
                                z += dk + t * (ek - dk)
                                total += 1
                vertices[count, 0], vertices[count, 1], vertices[count, 2] = i + x / total, j + y / total, k + z / total
                index[i, j, k] = count
                count += 1
    faces = np.empty((6 * count + 16, 3), np.int32)
    made = 0
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                here = field[i, j, k] < 0
                for axis in range(3):
                    if axis == 0:
                        other = field[i + 1, j, k] < 0
                        a, b, c, d = index[i, j - 1, k - 1], index[i, j, k - 1], index[i, j, k], index[i, j - 1, k]
                    elif axis == 1:
                        other = field[i, j + 1, k] < 0
                        a, b, c, d = index[i - 1, j, k - 1], index[i - 1, j, k], index[i, j, k], index[i, j, k - 1]
                    else:
                        other = field[i, j, k + 1] < 0
                        a, b, c, d = index[i - 1, j - 1, k], index[i, j - 1, k], index[i, j, k], index[i - 1, j, k]
                    if here == other:
                        continue
                    if not here:  # the outside lies towards the low end of the edge
                        b, d = d, b
                    faces[made] = (a, b, c)
                    faces[made + 1] = (a, c, d)
                    made += 2
    return vertices[:count].copy(), faces[:made].copy()
