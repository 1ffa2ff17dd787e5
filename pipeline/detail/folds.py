"""Removes folds from a displaced surface: where a triangle would turn over, the displacement is smoothed."""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from rig.mesh import face_normals

Vertices = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]

MAX_TURN = 0.0  # cosine between a triangle before and after; a right angle is a fold
MIN_AREA = 0.02  # of the triangle's own, before
SWEEPS, RINGS = 60, 6  # of smoothing, and how far about a fold it may reach
GIVING_WAY = 0.8  # what a sweep leaves of a displacement, in the second half of them


def folded(before: Vertices, after: Vertices, faces: Faces) -> Bool[np.ndarray, " f"]:
    """Tells which triangles a displacement turns over, or squeezes to almost no area."""
    old, new = face_normals(before, faces), face_normals(after, faces)
    size, length = np.linalg.norm(old, axis=1), np.linalg.norm(new, axis=1)
    return ((old * new).sum(axis=1) <= MAX_TURN * size * length) | (length < MIN_AREA * size)


def unfolded(before: Vertices, after: Vertices, faces: Faces) -> Vertices:
    """Returns the displaced vertices ``after`` without folds. Around each fold the displacement from ``before`` is
    smoothed until no triangle is turned over. In the second half of the sweeps it also shrinks there, so that the
    vertices return towards ``before``."""
    bad = faces[folded(before, after, faces)]
    if not len(bad):
        return after
    local = _around(bad, faces, len(before), RINGS)
    rows = np.unique(local)  # everything below happens among these
    place = np.zeros(len(before), int)
    place[rows] = np.arange(len(rows))
    bad, local, old = place[bad], place[local], before[rows]
    moved, mean = after[rows] - old, _neighbour_mean(local, len(rows))
    for sweep in range(SWEEPS):
        give = np.unique(_around(bad, local, len(rows), 1))
        moved[give] = (1.0 if sweep < SWEEPS // 2 else GIVING_WAY) * (mean[give] @ moved)
        bad = local[folded(old, old + moved, local)]
        if not len(bad):
            break
    out = after.copy()
    out[rows] = old + moved
    return out


def _around(chosen: Int[np.ndarray, "b 3"], faces: Faces, count: int, rings: int) -> Int[np.ndarray, "g 3"]:
    """Returns the faces within the given number of rings about the chosen faces."""
    about = np.zeros(count, bool)
    about[chosen] = True
    for _ in range(rings - 1):
        about[faces[about[faces].any(axis=1)]] = True
    return faces[about[faces].any(axis=1)]


def _neighbour_mean(faces: Faces, count: int) -> sparse.csr_array:
    """Returns the matrix that takes, for each vertex, the mean over the corners of the faces at it; the vertex itself
    is among those corners."""
    rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()
    share = 1.0 / np.maximum(np.bincount(rows, minlength=count), 1)
    return sparse.csr_array((share[rows], (rows, columns)), shape=(count, count))
