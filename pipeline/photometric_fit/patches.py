"""Where photographs are compared: samples spread over the face region, and patches of samples about chosen vertices.

A patch is no square of an image and no tangent plane but a piece of the current surface itself: its samples move with
the head while it is fitted, so that all views of a patch are warped by the surface, lens distortion included. Samples
are shared by the patches that overlap, so that every image is read once per sample, whatever the size of the patches.
"""

from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int, Int32
from scipy.spatial import KDTree

from pipeline.head_model.model import HeadModel
from rig.mesh import vertex_normals


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Holds s samples of the full level's triangles, and C patches of them (start, member: compressed rows)."""

    corners: Int32[np.ndarray, "s 3"]
    shares: Float[np.ndarray, "s 3"]
    centre: Int[np.ndarray, " c"]  # vertices of the full level
    start: Int[np.ndarray, " c1"]
    member: Int[np.ndarray, " e"]
    square_mm2: Float[np.ndarray, " e"]  # squared distance to the centre on the mean head
    agreement: Float[np.ndarray, " e"]  # cosine between the normals: nothing across a fold

    def points(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "s 3"]:
        return _mixed(vertices, self.corners, self.shares)

    def mixed(self, values: Float[np.ndarray, " v"]) -> Float[np.ndarray, " s"]:
        """Returns what the vertices have, at the samples."""
        return np.einsum("sk,sk->s", self.shares, values[self.corners])

    def normals(self, vertex_normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "s 3"]:
        mixed = _mixed(vertex_normals, self.corners, self.shares)
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)

    def sums(self, weights: Float[np.ndarray, " e"], values: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "c n"]:
        """Returns weighted sums over the samples of each patch."""
        shape = (len(self.centre), len(self.corners))
        return sparse.csr_array((weights, self.member, self.start), shape=shape) @ values

    def weights(self, size_mm: float) -> Float[np.ndarray, " e"]:
        """Returns a Gaussian window of that standard deviation."""
        return np.exp(-0.5 * self.square_mm2 / size_mm**2) * self.agreement


def make_patches(model: HeadModel, *, sample_mm: float, centre_mm: float, radius_mm: float) -> Patches:
    """Returns samples about ``sample_mm`` and patches about ``centre_mm`` apart, each patch a ball of ``radius_mm``."""
    level = model.levels["full"]
    vertices = model.vertices(np.zeros(0))
    normals = vertex_normals(vertices, level.faces)
    corners, shares = spread_samples(vertices, level.faces[level.face_region[level.faces].all(axis=1)], sample_mm)
    points, facing = _mixed(vertices, corners, shares), _mixed(normals, corners, shares)
    centre = thinned(vertices, np.unique(corners), centre_mm)
    balls = KDTree(points).query_ball_point(vertices[centre], radius_mm, return_sorted=False)
    counts = np.array([len(ball) for ball in balls])
    member = np.concatenate(balls).astype(np.int64) if len(balls) else np.zeros(0, np.int64)
    owner = np.repeat(np.arange(len(centre)), counts)
    square = ((points[member] - vertices[centre][owner]) ** 2).sum(axis=1)
    agreement = np.clip(np.einsum("ec,ec->e", facing[member], normals[centre][owner]), 0.0, 1.0)
    return Patches(corners, shares, centre, np.r_[0, np.cumsum(counts)], member, square, agreement)


def arrays_of(patches: Patches) -> dict[str, np.ndarray]:
    """Returns them by the names of the fields."""
    return {field.name: getattr(patches, field.name) for field in fields(patches)}


def spread_samples(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], spacing_mm: float
) -> tuple[Int32[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Returns about one sample in ``spacing_mm`` squared: large triangles are split, some of the small ones skipped."""
    a, b, c = (vertices[faces[:, j]] for j in range(3))
    wanted = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1) / spacing_mm**2
    splits = np.maximum(np.round(np.sqrt(wanted)), 1).astype(int)
    # Small triangles: one sample each time their areas, summed up in the order of the mesh, pass the next whole number.
    whole = np.floor(np.cumsum(np.where(wanted < 1, wanted, 0.0)))
    kept = (wanted >= 1) | (np.diff(whole, prepend=0.0) > 0)
    corners, shares = [np.zeros((0, 3), np.int32)], [np.zeros((0, 3))]
    for k in np.unique(splits[kept]):
        split, at = faces[kept & (splits == k)], _centroids(int(k))
        corners.append(np.repeat(split, len(at), axis=0).astype(np.int32))
        shares.append(np.tile(at, (len(split), 1)))
    return np.concatenate(corners), np.concatenate(shares)


def _centroids(k: int) -> Float[np.ndarray, "n 3"]:
    """Barycentric centres of the k^2 triangles that a triangle splits into."""
    upward = [(i + 1 / 3, j + 1 / 3) for i in range(k) for j in range(k - i)]
    downward = [(i + 2 / 3, j + 2 / 3) for i in range(k) for j in range(k - 1 - i)]
    found = np.array(upward + downward) / k
    return np.column_stack([1.0 - found.sum(axis=1), found])


def thinned(
    vertices: Float[np.ndarray, "v 3"], rows: Int[np.ndarray, " n"], spacing_mm: float
) -> Int[np.ndarray, " c"]:
    """Returns one of ``rows`` in every cube of that edge: the one nearest to its middle."""
    scaled = vertices[rows] / spacing_mm
    cell = np.floor(scaled).astype(np.int64)
    _, cube = np.unique(cell, axis=0, return_inverse=True)
    off = np.abs(scaled - cell - 0.5).sum(axis=1)
    order = np.lexsort((off, cube.ravel()))
    first = np.diff(cube.ravel()[order], prepend=-1) != 0
    return rows[order[first]]


def _mixed(values: Float[np.ndarray, "v 3"], corners: np.ndarray, shares: np.ndarray) -> Float[np.ndarray, "s 3"]:
    return np.einsum("sk,skc->sc", shares, values[corners])
