"""Chooses where photographs are compared: sample points over the face region, and patches of samples around chosen
vertices.

A patch is a piece of the curved surface of the current head, not a square of an image or a tangent plane. A patch's
samples move with the head during the fit and are projected into each view, with lens distortion. Overlapping patches
share samples, so every image is read once per sample for any size of the patches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int, Int32
from scipy.spatial import KDTree

from pipeline.head_model.model import HeadModel
from rig.mesh import vertex_normals

HAIR_SHARE = 0.5  # of what the views see of a patch, from which on it is hair's
REACH_MM = 5.0  # a patch so near to hair still holds some of it: two windows

HairProbability = Mapping[str, Float32[np.ndarray, "_ _"]]  # by camera, on the photograph's own grid


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Holds s sample points on triangles of the head model's finest mesh, and c patches. A sample is a point inside a
    triangle; a patch is the set of samples around a vertex.

    ``corners`` and ``shares`` are the triangle and barycentric coordinates of each sample. Patch i consists of the
    samples ``member[start[i]:start[i + 1]]``; e counts all members.
    """

    corners: Int32[np.ndarray, "s 3"]
    shares: Float[np.ndarray, "s 3"]
    centre: Int[np.ndarray, " c"]  # vertices of the full level
    start: Int[np.ndarray, " c1"]
    member: Int[np.ndarray, " e"]
    square_mm2: Float[np.ndarray, " e"]  # squared distance to the centre on the mean head
    agreement: Float[np.ndarray, " e"]  # cosine between the normals: nothing across a fold

    def points(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "s 3"]:
        """Returns the positions of the samples for the given vertices of the finest mesh."""
        return _mixed(vertices, self.corners, self.shares)

    def mixed(self, values: Float[np.ndarray, " v"]) -> Float[np.ndarray, " s"]:
        """Interpolates values at the vertices of the finest mesh to the samples."""
        return np.einsum("sk,sk->s", self.shares, values[self.corners])

    def normals(self, vertex_normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "s 3"]:
        """Returns the unit normal at each sample, interpolated from the vertex normals."""
        mixed = _mixed(vertex_normals, self.corners, self.shares)
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True)

    def sums(self, weights: Float[np.ndarray, " e"], values: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "c n"]:
        """Returns, for each patch, the sum of ``values`` over its samples, weighted by ``weights``."""
        shape = (len(self.centre), len(self.corners))
        return sparse.csr_array((weights, self.member, self.start), shape=shape) @ values

    def weights(self, size_mm: float) -> Float[np.ndarray, " e"]:
        """Returns the weight of each sample in each patch: a Gaussian of the distance to the patch's centre with
        standard deviation ``size_mm``, times the agreement of the normals."""
        return np.exp(-0.5 * self.square_mm2 / size_mm**2) * self.agreement


def make_patches(model: HeadModel, *, sample_mm: float, centre_mm: float, radius_mm: float) -> Patches:
    """Spreads samples about ``sample_mm`` apart over the face region of the mean head, and patch centres about
    ``centre_mm`` apart. A patch consists of all samples within ``radius_mm`` of its centre."""
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
    """Returns the arrays of the patches, by the names of their fields."""
    return {field.name: getattr(patches, field.name) for field in fields(patches)}


def spread_samples(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], spacing_mm: float
) -> tuple[Int32[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Spreads sample points over triangles, about one for each square with an edge of ``spacing_mm``. Returns, for each
    sample, the three vertices of its triangle and its barycentric coordinates. A large triangle gets several samples;
    several small triangles share one sample."""
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
    """Returns the barycentric coordinates of the centroids when a triangle is divided into k^2 equal triangles."""
    upward = [(i + 1 / 3, j + 1 / 3) for i in range(k) for j in range(k - i)]
    downward = [(i + 2 / 3, j + 2 / 3) for i in range(k) for j in range(k - 1 - i)]
    found = np.array(upward + downward) / k
    return np.column_stack([1.0 - found.sum(axis=1), found])


def thinned(
    vertices: Float[np.ndarray, "v 3"], rows: Int[np.ndarray, " n"], spacing_mm: float
) -> Int[np.ndarray, " c"]:
    """Returns one of the vertices ``rows`` for each cube with an edge of ``spacing_mm``: the vertex nearest to the
    cube's centre."""
    scaled = vertices[rows] / spacing_mm
    cell = np.floor(scaled).astype(np.int64)
    _, cube = np.unique(cell, axis=0, return_inverse=True)
    off = np.abs(scaled - cell - 0.5).sum(axis=1)
    order = np.lexsort((off, cube.ravel()))
    first = np.diff(cube.ravel()[order], prepend=-1) != 0
    return rows[order[first]]


def _mixed(values: Float[np.ndarray, "v 3"], corners: np.ndarray, shares: np.ndarray) -> Float[np.ndarray, "s 3"]:
    return np.einsum("sk,skc->sc", shares, values[corners])


def under_hair(
    patches: Patches,
    hair: HairProbability,
    names: Sequence[str],
    pixel: Float[np.ndarray, "k s 2"],
    seen: Bool[np.ndarray, "k s"],
    centres: Float[np.ndarray, "c 3"],
) -> Bool[np.ndarray, " c"]:
    """Returns a mask of the patches that show hair or lie within ``REACH_MM`` of a patch that does, because their
    windows include hair. Hair matches well between photographs, but its surface lies above the skin.

    ``patches``: samples of the face and patches of them. ``hair``: probability that a pixel shows hair, by camera;
    cameras without a map are ignored. ``names``: names of the k cameras. ``pixel``: the pixel at which each camera sees
    each sample. ``seen``: whether it sees the sample. ``centres``: centres of the patches, mm.
    """
    total, views = np.zeros(pixel.shape[1]), np.zeros(pixel.shape[1])
    for k, name in enumerate(names):
        if name in hair:
            column, row = np.rint(pixel[k, seen[k]]).astype(int).T
            total[seen[k]] += hair[name][row, column]
            views[seen[k]] += 1
    known = (views > 0).astype(float)
    shown = patches.sums(patches.agreement, np.stack([total / np.maximum(views, 1.0) * known, known], axis=1))
    sure = shown[:, 0] / np.maximum(shown[:, 1], 1e-9) > HAIR_SHARE
    return KDTree(centres[sure]).query(centres)[0] < REACH_MM if sure.any() else sure
