"""Fills in values at vertices that have none, smoothly over the mesh. Each ring of vertices takes the mean of the ring
before; the filled part is then relaxed towards the mean of its neighbours (harmonic fill), with known vertices
fixed."""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int, Int32

from pipeline.texturing.inpaint_kernels import LANES, by_rings, first_guess, relax

RELAXATIONS = ((60, 1.7), (10, 1.0))  # sweeps and factor: over-relaxed, then plain, which calms what overshot


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[Int32[np.ndarray, " s"], Int32[np.ndarray, " e"]]:
    """Returns which vertices share an edge, as compressed rows: the neighbours of vertex i are
    ``indices[starts[i]:starts[i + 1]]``."""
    along = np.roll(faces, -1, axis=1)
    ends = np.concatenate([faces, along]).ravel(), np.concatenate([along, faces]).ravel()
    pairs = sparse.csr_array((np.ones(len(ends[0]), bool), ends), shape=(count, count))  # adds up what is there twice
    return pairs.indptr, pairs.indices


def fill_unknown(
    values: Float[np.ndarray, "v c"], known: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v c"]:
    """Fills in the values (at most four channels) of unknown vertices smoothly from their neighbours. A part of the
    mesh without any known vertex gets the mean of all known ones."""
    out = values.astype(float)
    if known.all() or not known.any():
        return out
    out[~known] = out[known].mean(axis=0)
    starts, indices = neighbours(faces, len(values))
    order = by_rings(starts, indices, known)
    lanes = np.zeros((len(values), LANES), np.float32)
    lanes[:, : values.shape[1]] = out
    first_guess(lanes, starts, indices, order, known.copy())
    for sweeps, factor in RELAXATIONS:
        relax(lanes, starts, indices, order, sweeps, factor)
    out[order] = lanes[order, : values.shape[1]]
    return out
