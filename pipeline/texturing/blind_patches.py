"""Colours wide triangles that cameras see although they see none of the corners.

A model whose eyes are openings has them closed by strips from lid to lid (``close_openings`` of imports). Every vertex
of a strip lies on the opening's rim, which the lids hide, so that no view would be chosen for it, and the eyeball would
be painted in the colour of the skin around it. Such a patch takes its colours from the one photograph that sees most of
it.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse.csgraph import connected_components

from pipeline.imaging.silhouette import Silhouette
from pipeline.texturing.decision import Decision
from pipeline.texturing.visibility import see_weights
from rig.mesh import Mesh, face_normals

INNER = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4], [2, 2, 2]]) / 6.0  # places in a triangle that are looked at
MIN_MM2 = 20.0  # of a patch: an open eye has 200, a fold of the skin less
MIN_SHOWN = 0.5  # of a triangle, in some view
MIN_SEEN = 0.4  # of the patch's area, in the view that it takes; lids hide its upper third from most
MAX_KNOWN = 0.5  # of the corners of its triangles, by area, that some view sees: beyond, it is no opening, but skin
BARELY = np.float32(1e-9)  # weight of a view at a corner that it does not see


def fill_unobserved_patches(
    decision: Decision,
    mesh_world: Mesh,
    silhouettes: Mapping[str, Silhouette],
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
) -> Decision:
    """Returns the decision with a view added at the corners of every wide patch that a camera sees although it sees
    none of the corners, such as a strip that closes an eye."""
    rows = np.flatnonzero(_blind(decision.weights, mesh_world.faces))
    faces, normals, area = _parts(mesh_world, rows)
    rows = rows[_wide(faces, area)]
    if not len(rows):
        return decision
    faces, normals, area = _parts(mesh_world, rows)
    points = np.einsum("pk,fkx->fpx", INNER, mesh_world.vertices[faces]).reshape(-1, 3)
    facing = np.repeat(normals, len(INNER), axis=0)
    found = [see_weights(view, silhouettes[view.name], depths[view.name], points, facing) for view in decision.views]
    seen = np.stack(found).reshape(len(found), len(rows), len(INNER))
    shown = (seen > 0).mean(axis=2).max(axis=0) >= MIN_SHOWN  # the hidden side of a lid is blind as the eye is
    faces, area, seen = faces[shown], area[shown], seen[:, shown]
    wide = _wide(faces, area)
    return _taken(decision, faces[wide], area[wide], _patches(faces[wide]), seen[:, wide])


def _parts(
    mesh: Mesh, rows: Int[np.ndarray, " f"]
) -> tuple[Int[np.ndarray, "f 3"], Float[np.ndarray, "f 3"], Float[np.ndarray, " f"]]:
    """Triangles, their unit normals and areas (mm2)."""
    faces = mesh.faces[rows]
    normals = face_normals(mesh.vertices, faces)
    doubled = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    return faces, normals / doubled[:, None], 0.5 * doubled


def _wide(faces: Int[np.ndarray, "f 3"], area: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Triangles of patches that are large enough."""
    patch = _patches(faces)
    return np.bincount(patch, area)[patch] >= MIN_MM2 if len(faces) else np.zeros(0, bool)


def _taken(
    decision: Decision,
    faces: Int[np.ndarray, "f 3"],
    area: Float[np.ndarray, " f"],
    patch: Int[np.ndarray, " f"],
    seen: Float32[np.ndarray, "k f p"],
) -> Decision:
    slots, shares, weights = decision.slots.copy(), decision.shares.copy(), decision.weights.copy()
    known = np.any(decision.weights > 0, axis=0)[faces].mean(axis=1)
    for number in np.unique(patch):
        rows = np.flatnonzero(patch == number)
        share = ((seen[:, rows] > 0).mean(axis=2) * area[rows]).sum(axis=1) / area[rows].sum()
        if (known[rows] * area[rows]).sum() > MAX_KNOWN * area[rows].sum():
            continue
        worth = np.where(share >= MIN_SEEN, (seen[:, rows].mean(axis=2) * area[rows]).sum(axis=1), 0.0)
        best = int(worth.argmax())
        if worth[best] <= 0:
            continue
        corners = np.unique(faces[rows])
        weights[best, corners] = np.maximum(weights[best, corners], BARELY)
        unseen = corners[slots[corners, 0] < 0]
        slots[unseen, 0], shares[unseen, 0] = best, 1.0
    return replace(decision, slots=slots, shares=shares, weights=weights)


def _blind(weights: Float32[np.ndarray, "k v"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Triangles of which no view sees all corners."""
    out = np.ones(len(faces), bool)
    for view in weights:
        out &= ~(view[faces] > 0).all(axis=1)
    return out


def _patches(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """The patch of each triangle: they hang together by edges."""
    count = len(faces)
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    owner = np.tile(np.arange(count), 3)
    shape = (count, int(edge.max(initial=-1)) + 1)
    touches = sparse.csr_array((np.ones(3 * count), (owner, edge.ravel())), shape=shape)
    return connected_components(touches @ touches.T, directed=False)[1]
