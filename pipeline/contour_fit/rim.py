"""Finds the rim of a head, the curve that projects to its outline, in every camera without drawing an image.

For a surface point X with normal N and a camera centre C_k, the rim is where ``N . (X - C_k) = 0``. The product ``N .
(X - C_k)`` is interpolated along mesh edges to find the zero crossing. A rim point is on the *outer* outline if a step
outwards leaves the model's mask. Instead of a drawn mask, the test uses the mesh's silhouette edges, between
front-facing and back-facing faces (counted twice), and its border edges (counted once). The winding number of these
edges around a pixel is the number of faces over the pixel. Each test visits only the edges that cross one image row.

The tangent plane at the rim contains the viewing ray. With P = d(pixel)/dX the outline's normal in the image is
therefore ``n = l / |l|, l = N^T P^+``, and ``n^T P = N^T / |l|``. A shift of the rim along the surface has no effect to
first order.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from pipeline.compute.threads import in_threads
from pipeline.contour_fit.rim_kernels import (
    BLEND,
    COLUMNS,
    LENGTH,
    NX,
    RESIDUAL,
    SLOPE,
    Pictures,
    Surface,
    U,
    X,
    find_rim_samples,
    normals_and_planes,
    sweep_views,
)
from pipeline.geometry.projection import packed_lens
from rig.rig import Rig

MAX_SAMPLES = 6000  # rim samples of one view; a full head has about 1,000
VIEWS_A_WORD = 64  # views that are swept together, a bit each
STEPS_OUT_PX = (0.3, 2.5)  # both must leave the mask: the second drops samples at the edge of T-junctions and grooves


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """Holds the faces, edges and regions of a mesh level, for the search for its rim."""

    faces: Int32[np.ndarray, "f 3"]
    edges: Int32[np.ndarray, "e 4"]  # from, to (as in face one), face one, face two or -1
    face: Int32[np.ndarray, " s"]  # triangles of the face region, whose rim may always speak
    head: Int32[np.ndarray, " t"]  # those and cranium and ears, whose rim speaks where there is no hair


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Holds the cameras and the signed distances (px) to their silhouettes, packed in flat arrays for compiled
    loops."""

    names: tuple[str, ...]
    rotation: Float[np.ndarray, "k 3 3"]
    translation: Float[np.ndarray, "k 3"]
    lens: Float[np.ndarray, "k 10"]  # packed_lens of each
    size: Int32[np.ndarray, "k 2"]  # width, height
    distance: Float32[np.ndarray, " pixels"]  # all views, one after the other, row by row
    offset: Int[np.ndarray, " k"]

    def distance_map(self, k: int) -> Float32[np.ndarray, "h w"]:
        """Returns the signed distances (px) of view k as an image."""
        width, height = self.size[k]
        return self.distance[self.offset[k] : self.offset[k] + width * height].reshape(height, width)

    def packed(self) -> Float[np.ndarray, "k 22"]:
        """Returns one row for each camera: rotation (9) and translation (3, mm) of ``camera_from_world``, then
        intrinsics (10)."""
        return np.concatenate([self.rotation.reshape(-1, 9), self.translation, self.lens], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Holds samples of a head's rim: the points on the outer outline where the rim crosses mesh edges. The arrays hold
    the samples of all views, one view after another."""

    view: Int32[np.ndarray, " s"]
    corner: Int32[np.ndarray, "s 2"]  # the edge's two vertices
    blend: Float[np.ndarray, " s"]  # weight of the second one
    point: Float[np.ndarray, "s 3"]  # world, mm
    gradient: Float[np.ndarray, "s 3"]  # n^T P: change of the outline's position along n (px) per mm of the point
    pixel: Float[np.ndarray, "s 2"]
    normal: Float[np.ndarray, "s 2"]  # outward, unit, in the image
    length: Float[np.ndarray, " s"]  # px of outline that the sample stands for
    residual: Float[np.ndarray, " s"]  # D_obs, px; negative: the model lies inside the input


def make_topology(
    faces: Int[np.ndarray, "f 3"],
    face_region: Bool[np.ndarray, " v"],
    head_region: Bool[np.ndarray, " v"] | None = None,
) -> Topology:
    """Builds the topology of a mesh: its edges, each with its two faces, and the faces of both regions. If
    ``head_region`` is None, the head is the whole mesh. Raises ValueError if more than two faces share an edge."""
    faces = np.ascontiguousarray(faces, np.int32)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    low, high = directed.min(axis=1).astype(np.int64), directed.max(axis=1).astype(np.int64)
    order = np.argsort(low * (faces.max() + 1) + high, kind="stable")
    key = (low * (faces.max() + 1) + high)[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[first, len(key)])
    if count.max() > 2:
        raise ValueError(f"{(count > 2).sum()} edges have more than two faces")
    edges = np.full((len(first), 4), -1, np.int32)
    edges[:, :2], edges[:, 2] = directed[order[first]], owner[order[first]]
    edges[count == 2, 3] = owner[order[first[count == 2] + 1]]
    everything = np.ones(len(faces), bool)
    head = everything if head_region is None else (face_region | head_region)[faces].all(axis=1)
    regions = (np.flatnonzero(of).astype(np.int32) for of in (face_region[faces].all(axis=1), head))
    return Topology(faces, edges, *regions)


def pack_views(rig: Rig, distances: dict[str, Float32[np.ndarray, "h w"]]) -> Views:
    """Packs the cameras of ``rig`` that have a signed distance, and these distances (px), into flat arrays."""
    cameras = [camera for camera in rig if camera.name in distances]
    maps = [np.ascontiguousarray(distances[camera.name], np.float32) for camera in cameras]
    return Views(
        names=tuple(camera.name for camera in cameras),
        rotation=np.stack([camera.camera_from_world.rotation for camera in cameras]),
        translation=np.stack([camera.camera_from_world.translation for camera in cameras]),
        lens=np.stack([packed_lens(camera) for camera in cameras]),
        size=np.array([m.shape[::-1] for m in maps], np.int32),
        distance=np.concatenate([m.ravel() for m in maps]),
        offset=np.cumsum([0] + [m.size for m in maps])[:-1].astype(np.int64),
    )


def find_rim(
    topology: Topology,
    vertices_world: Float[np.ndarray, "v 3"],
    views: Views,
    *,
    whole_head: bool = False,
    averaged: bool = False,
) -> Rim:
    """Finds samples of a mesh's outer outline in every view, and reads the silhouette's signed distance (px) at each.

    With ``whole_head`` cranium and ears are searched too; otherwise only the face region. If ``averaged``, each
    distance is a mean along the outline, half way to the two neighbouring samples. The mean distance is meant for
    meshes with edges of 2 to 6 px in the image.
    """
    faces = topology.head if whole_head else topology.face
    vertices = np.ascontiguousarray(vertices_world)
    normals, planes = normals_and_planes(vertices, topology.faces)
    surface = Surface(vertices, normals, topology.faces, topology.edges)
    words = [slice(k, k + VIEWS_A_WORD) for k in range(0, len(views.names), VIEWS_A_WORD)]
    found = [part for some in words for part in _outlines(surface, planes, faces, views, some, averaged)]
    view = np.repeat(np.arange(len(found), dtype=np.int32), [len(corner) for corner, _ in found])
    corner, values = (np.concatenate([part[i] for part in found]) for i in (0, 1))
    return Rim(
        view, corner, values[:, BLEND], values[:, X : X + 3], values[:, SLOPE : SLOPE + 3], values[:, U : U + 2],
        values[:, NX : NX + 2], values[:, LENGTH], values[:, RESIDUAL],
    )  # fmt: skip


def _outlines(
    surface: Surface,
    planes: Float[np.ndarray, "4 f"],
    active: Int32[np.ndarray, " s"],
    views: Views,
    some: slice,
    averaged: bool,
) -> list[tuple[Int32[np.ndarray, "_ 2"], Float[np.ndarray, "_ 14"]]]:
    """Returns, for each of at most ``VIEWS_A_WORD`` views, the rim samples and the end points of their mesh edges;
    ``rim_kernels`` names the samples' columns.

    A single pass over the mesh's faces and vertices serves all views, with one bit for each view. After the common pass
    each view only visits the faces on its rim.
    """
    centres = -np.einsum("kji,kj->ki", views.rotation[some], views.translation[some])
    pictures = Pictures(views.packed()[some], centres, views.size[some], views.distance, views.offset[some])
    sweep = sweep_views(surface, planes, active, centres)
    counts = np.zeros(len(centres), np.int64)
    corners = np.empty((len(centres), MAX_SAMPLES, 2), np.int32)
    samples = np.empty((len(centres), MAX_SAMPLES, COLUMNS))
    steps = np.array(STEPS_OUT_PX)

    def fill(first: int, last: int) -> None:
        find_rim_samples(first, last, surface, sweep, pictures, steps, averaged, counts, corners, samples)

    in_threads(len(centres), fill)
    return [(corners[k, :count], samples[k, :count]) for k, count in enumerate(counts.tolist())]
