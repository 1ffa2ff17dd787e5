"""Stores mesh adjacency in compressed rows, interpolates unknown vertex values, and corrects photographs so that they
meet without a visible seam.

Waechter et al. (2014, section 4.3) add smooth corrections that make both sides of every seam agree. In this module each
view gets a smooth correction (sRGB codes) on the whole surface that it sees. The correction moves the view's colours to
the robust mean of all views (a screened Poisson equation), so any two views can be blended.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.texturing.paint_kernels import LANES, by_rings, first_guess, relax
from pipeline.texturing.view_selection_kernels import level_view


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Holds the neighbours of each vertex as compressed rows: those of vertex i are ``indices[starts[i]:starts[i +
    1]]``. Every edge is stored twice, in the rows of both ends; ``opposite`` is the position of its other entry."""

    starts: Int32[np.ndarray, " s"]
    indices: Int32[np.ndarray, " e"]
    opposite: Int32[np.ndarray, " e"]

    @classmethod
    def of(cls, starts: Int32[np.ndarray, " s"], indices: Int32[np.ndarray, " e"]) -> "Neighbourhood":
        """Builds the neighbourhood from compressed rows: ``starts`` and sorted ``indices`` of a symmetric adjacency."""
        rows = np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))
        # Rows are sorted: ordered by the other end first, the edges of its row come in the same order.
        opposite = np.empty(len(indices), np.int32)
        opposite[np.lexsort((rows, indices))] = np.arange(len(indices), dtype=np.int32)
        return cls(starts, indices, opposite)

    @property
    def rows(self) -> Int32[np.ndarray, " e"]:
        """Returns, for each entry of ``indices``, the vertex whose neighbour it is."""
        return np.repeat(np.arange(len(self.starts) - 1, dtype=np.int32), np.diff(self.starts))

    def smooth(self, values: Float[np.ndarray, "v c"], rounds: int) -> Float[np.ndarray, "v c"]:
        """Smooths values over the mesh: in each round a vertex's value becomes the average of itself and its
        neighbours' mean."""
        count = len(self.starts) - 1
        share = 0.5 / np.maximum(np.diff(self.starts), 1)
        means = sparse.csr_array((np.repeat(share, np.diff(self.starts)), self.indices, self.starts), (count, count))
        for _ in range(rounds):
            values = 0.5 * values + means @ values
        return values


SEAM_RINGS = 6  # of vertices, a millimetre or two apart: a hairline that nobody saw is no straight cut
LEVELLING = 10.0  # weight of a correction's step along an edge, by one of a departure from the views' mean
SWEEPS, FACTOR = 25, 1.7  # over-relaxed: corrections are right to 0.1 code after them
RELAXATIONS = ((60, 1.7), (10, 1.0))  # sweeps and factor: over-relaxed, then plain, which calms what overshot


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[Int32[np.ndarray, " s"], Int32[np.ndarray, " e"]]:
    """Returns which vertices share an edge, as compressed rows: the neighbours of vertex i are
    ``indices[starts[i]:starts[i + 1]]``."""
    along = np.roll(faces, -1, axis=1)
    ends = np.concatenate([faces, along]).ravel(), np.concatenate([along, faces]).ravel()
    pairs = sparse.csr_array((np.ones(len(ends[0]), bool), ends), shape=(count, count))  # adds up what is there twice
    return pairs.indptr, pairs.indices


def fill_unknown(
    values: Float[np.ndarray, "v c"],
    known: Bool[np.ndarray, " v"],
    faces: Int[np.ndarray, "f 3"],
    parts: UInt8[np.ndarray, " v"] | None = None,
) -> Float[np.ndarray, "v c"]:
    """Fills in the values (at most four channels) of unknown vertices smoothly from their neighbours. A piece of the
    mesh without any known vertex gets the mean of all known values. With ``parts`` (labels such as skin or hair), a
    vertex is filled only from its own part, if possible. Filled parts that meet are blended over ``SEAM_RINGS``
    rings."""
    if parts is None:
        return _fill(values, known, faces)
    out, sure = values.astype(float), known.copy()
    for part in np.unique(parts[known]):
        within = parts == part
        out[within] = _fill(values, known & within, faces[within[faces].all(axis=1)])[within]
        sure |= within
    seam = np.zeros(len(parts), bool)
    seam[faces[np.ptp(parts[faces], axis=1) > 0]] = True
    for _ in range(SEAM_RINGS):
        seam[faces[seam[faces].any(axis=1)]] = True
    return _fill(out, sure & (known | ~seam), faces)


def _fill(
    values: Float[np.ndarray, "v c"], known: Bool[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v c"]:
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


def level_views(
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    around: Neighbourhood,
) -> Float32[np.ndarray, "k v 4"]:
    """Computes the correction of each view at each vertex (sRGB codes; the fourth channel is 0) that makes seams
    between views invisible.

    Args:
        weights: how well each view sees each vertex; 0 = not seen.
        codes: sRGB codes of every view at every vertex.
        agreed: codes on which the views of each vertex agree.
        around: the mesh's edges.
    """
    fields = np.zeros((*weights.shape, 4), np.float32)
    fields[:, :, :3] = (agreed - codes) * (weights > 0)[:, :, None]

    def work(k: int) -> None:
        level_view(fields[k], weights[k] > 0, around.starts, around.indices, LEVELLING, SWEEPS, FACTOR)

    map_in_threads(work, len(weights))
    return fields
