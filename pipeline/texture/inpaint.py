"""Values for the vertices that have none, smooth over the mesh: each ring takes the mean of the ring before, and the
filled part is then relaxed towards its neighbours' mean (the harmonic fill), the known vertices staying as they are."""

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.texture.inpaint_kernels import by_rings, first_guess, relax

RELAXATIONS = ((60, 1.7), (10, 1.0))  # sweeps and factor: over-relaxed, then plain, which calms what overshot


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Adjacency of the vertices in compressed rows: starts (count + 1,) and indices. A pair may occur twice."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    order = np.argsort(ends[:, 0], kind="stable")
    starts = np.zeros(count + 1, np.int64)
    np.cumsum(np.bincount(ends[:, 0], minlength=count), out=starts[1:])
    return starts, ends[order, 1].astype(np.int32)


def fill_unknown(
    values: Float[np.ndarray, "v c"], known: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v c"]:
    """``values`` with the unknown ones filled; parts of the mesh that know nothing take the mean of the rest."""
    out = values.astype(float)
    if known.all() or not known.any():
        return out
    out[~known] = out[known].mean(axis=0)
    starts, indices = neighbours(faces, len(values))
    order = by_rings(starts, indices, known)
    first_guess(out, starts, indices, order, known.copy())
    for sweeps, factor in RELAXATIONS:
        relax(out, starts, indices, order, sweeps, factor)
    return out
