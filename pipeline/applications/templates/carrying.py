"""Deforms a template's vertices together with a fitted head.

A skin vertex of the template stores its triangle of the head model, its barycentric coordinates in that triangle, and
its offset in the triangle's frame. Vertices below the skin (mouth, sockets, lashes) follow the surrounding skin by the
smooth map in ``warp_by_landmarks``. Closed parts (eyeballs, teeth) get a similarity, so that a ball stays a ball.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from pipeline.geometry.registration.nonrigid import warp_by_landmarks
from pipeline.geometry.registration.rigid import procrustes
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.gaussian_process import spread_nodes

CANDIDATES = 16  # nearest triangles that are tested for a vertex
ANCHORS = 360  # vertices of the skin that lead what lies deeper: 3 mm apart along lids and lips
ALL_OVER = 60  # ... of them spread over all of the skin
WHOLE_ANCHORS = 40  # that lead a closed part


@dataclass(frozen=True, slots=True, eq=False)
class Attachment:
    """Holds points attached to a triangle mesh: the triangle of each point, its barycentric coordinates there, and its
    offset in the triangle's frame (``frames``)."""

    triangles: Int[np.ndarray, " n"]  # rows of the surface's faces
    weights: Float[np.ndarray, "n 3"]  # barycentric
    offsets: Float[np.ndarray, "n 3"]  # mm, in the triangle's frame (``frames``)

    def on(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "n 3"]:
        """Returns the positions of the attached points for the given positions of the mesh's vertices."""
        corners = vertices[faces[self.triangles]]
        off = np.einsum("nax,na->nx", frames(corners), self.offsets)
        return np.einsum("nk,nkx->nx", self.weights, corners) + off


def bind_vertices(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
) -> tuple[Attachment, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Attaches each point to the nearest point of a mesh that has a similar normal. Returns the attachment, the
    distances (mm), and the cosine between each point's unit normal and the mesh's normal."""
    surface = SurfaceIndex(vertices, faces)
    hits = surface.closest(points, CANDIDATES, facing=normals)
    offsets = np.einsum("nax,nx->na", frames(vertices[faces[hits.triangles]]), points - hits.points)
    cosine = np.einsum("nx,nx->n", normals, hits.normals)
    return Attachment(hits.triangles, hits.weights, offsets), hits.distances, cosine


def frames(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Returns three unit vectors for each triangle, as rows: along its first edge, across that edge in the plane, and
    the normal; zero if the triangle has no area."""
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(along, other)
    axes = np.stack([along, np.cross(normal, along), normal], axis=1)
    return axes / np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), 1e-12)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceBinding:
    """Holds how a template's n vertices follow a head model's surface: attached skin vertices, anchors for others."""

    rest: Float[np.ndarray, "t 3"]  # the registered mesh, mm
    skin: Int[np.ndarray, " n"]  # vertices attached to the surface by ``attachment``
    attachment: Attachment
    anchors: Int[np.ndarray, " a"]  # of ``skin``, rows of the mesh, that lead the rest
    wholes: Int[np.ndarray, " t"]  # number of the closed part that a vertex belongs to, -1 of none
    whole_anchors: Int[np.ndarray, "w k"]  # rows of the mesh that lead each closed part

    def on(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "t 3"]:
        """Returns the template's vertices deformed with a fitted head. ``vertices`` belong to the head model's finest
        mesh and may be in any frame, mm."""
        return self.with_skin(self.attachment.on(vertices, faces))

    def with_skin(self, skin: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "t 3"]:
        """Returns the template's vertices for given positions of its skin vertices; other vertices follow the skin."""
        out = np.empty_like(self.rest)
        out[self.skin] = skin
        deep = self.wholes < 0
        deep[self.skin] = False
        if deep.any():
            out[deep] = warp_by_landmarks(self.rest[self.anchors], out[self.anchors], self.rest[deep])
        for number, anchors in enumerate(self.whole_anchors):
            part = self.wholes == number
            out[part] = procrustes(self.rest[anchors], out[anchors]).apply(self.rest[part])
        return out


def surface_binding(
    rest: Float[np.ndarray, "t 3"], skin: Int[np.ndarray, " n"], attachment: Attachment, wholes: Int[np.ndarray, " t"]
) -> SurfaceBinding:
    """Builds a binding, and chooses the anchors: skin vertices that the deeper vertices will follow, some of them near
    and some spread over all of the skin."""
    tree = KDTree(rest[skin])
    deep = wholes < 0
    deep[skin] = False
    led = np.unique(np.asarray(tree.query(rest[deep])[1], int)) if deep.any() else np.zeros(0, int)
    near = led[spread_nodes(rest[skin[led]], min(ANCHORS - ALL_OVER, len(led)))] if len(led) else led
    over = spread_nodes(rest[skin], min(ALL_OVER, len(skin)))
    count = int(wholes.max(initial=-1)) + 1
    wanted = min(WHOLE_ANCHORS, len(skin))
    leads = [skin[_nearest(tree, rest[wholes == number], wanted)] for number in range(count)]
    return SurfaceBinding(
        rest=rest,
        skin=skin,
        attachment=attachment,
        anchors=skin[np.union1d(near, over)],
        wholes=wholes,
        whole_anchors=np.array(leads, int).reshape(count, wanted),
    )


def _nearest(tree: KDTree, part: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " k"]:
    """Returns at most ``count`` points of the tree, those nearest to any point of a part; for an eyeball these are the
    edges of its lids."""
    distance, row = tree.query(part, k=count)
    distance, row = np.ravel(distance), np.ravel(row)
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(row[order], return_index=True)
    return row[order][np.sort(first)[:count]]
