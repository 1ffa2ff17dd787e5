"""Measures repeatability: how far heads of one subject, shot several times, are from each other.

All heads have the model's own vertices, so that each vertex is compared with itself. Rigid motions, without scale,
remove where the subject sat: each head is laid on the mean of all over the given vertices, and the mean is computed
anew (generalised Procrustes analysis without scale; Gower 1975, https://doi.org/10.1007/BF02291478).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import rankdata

from rig.geometry import rigid_fit
from rig.mesh import vertex_normals

ROUNDS = 20  # of laying on and averaging; three are usual
STILL_MM = 1e-7  # a mean that moves by less is the mean


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Holds how each vertex scatters over several shots of one subject: standard deviations (mm) about the mean head.

    ``position_mm`` is over all three directions together, ``normal_mm`` along the mean head's normal. The mean head
    lies where the first head does.
    """

    mean: Float[np.ndarray, "v 3"]
    position_mm: Float[np.ndarray, " v"]
    normal_mm: Float[np.ndarray, " v"]

    def figures(
        self, stated_mm: Float[np.ndarray, " v"], weights: Float[np.ndarray, " v"], kept: Bool[np.ndarray, " v"]
    ) -> dict[str, float]:
        """Returns figures over the ``kept`` vertices, weighted by ``weights``: the RMS scatter and, beside it, the
        stated deviation (mm, along the normal).

        ``scatter_over_stated`` is their ratio: 1 if the stated deviation is all scatter, less if part of it is an error
        that each shot repeats. ``rank_correlation`` says whether vertices with a larger stated deviation scatter more.
        """
        share = weights[kept] / weights[kept].sum()
        position, normal, stated = self.position_mm[kept], self.normal_mm[kept], stated_mm[kept]
        rms, along, said = (float(np.sqrt(share @ values**2)) for values in (position, normal, stated))
        varied = min(float(np.ptp(values)) for values in (normal, stated)) > 0
        return {
            "rms_mm": rms,
            "median_mm": float(np.median(position)),
            "p95_mm": float(np.percentile(position, 95)),
            "normal_rms_mm": along,
            "normal_median_mm": float(np.median(normal)),
            "stated_mm": said,
            "stated_median_mm": float(np.median(stated)),
            "scatter_over_stated": along / said if said else 0.0,
            "rank_correlation": float(np.corrcoef(rankdata(normal), rankdata(stated))[0, 1]) if varied else 0.0,
        }


def scatter(
    heads: Float[np.ndarray, "n v 3"], faces: Int[np.ndarray, "f 3"], laid_on: Bool[np.ndarray, " v"]
) -> Scatter:
    """Computes the scatter of two or more heads (mm, each in its own frame) with the same vertices. The heads are first
    laid on each other over the vertices ``laid_on``."""
    if len(heads) < 2:
        raise ValueError(f"{len(heads)} heads have no scatter; two are needed")
    mean = heads[0]
    placed = heads
    for _ in range(ROUNDS):
        placed = np.stack([rigid_fit(head[laid_on], mean[laid_on]).apply(head) for head in heads])
        before, mean = mean, placed.mean(axis=0)
        mean = rigid_fit(mean[laid_on], heads[0][laid_on]).apply(mean)  # or the mean would wander with each round
        if np.abs(mean - before).max() < STILL_MM:
            break
    placed = np.stack([rigid_fit(head[laid_on], mean[laid_on]).apply(head) for head in heads])
    off = placed - placed.mean(axis=0)
    along = np.einsum("nvc,vc->nv", off, vertex_normals(mean, faces))
    free = len(heads) - 1
    return Scatter(mean, np.sqrt((off**2).sum(axis=(0, 2)) / free), np.sqrt((along**2).sum(axis=0) / free))
