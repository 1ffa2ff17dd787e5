"""Selects the photograph from which each part of the head takes its detail.

After Waechter, Moehrle and Goesele, *Let There Be Color! Large-Scale Texturing of 3D Reconstructions* (ECCV 2014): each
vertex is labelled with a view, so that the sum of two terms is least. The data term holds projected area and angle, the
visibility of all neighbours, how far a view's colour is from that of the others (highlight or shadow), and how strongly
the camera had to be corrected. The Potts term holds the edges between different labels, and costs most where the views
disagree, so that seams keep out of eyes and lips. Unlike there, labels are at vertices instead of faces: in the ring of
triangles at a seam, two photographs are then blended. The sum is minimised by belief propagation (Felzenszwalb and
Huttenlocher, *Efficient Belief Propagation for Early Vision*, IJCV 2006), in sweeps over the vertices forth and back.
"""

import numpy as np
from jaxtyping import Float, Float32, Int32

from pipeline.texturing.neighbourhood import Neighbourhood
from pipeline.texturing.view_selection_kernels import (
    NEVER,
    best_candidates,
    differences,
    fill_slots,
    propagate,
    ring_quality,
)

DISAGREEMENT = 0.06  # of the colour's code: a view that differs so much from the others ...
OUTLIER_COST = 2.0  # ... has half of this cost, by that of a view that sees nothing
SEAM_COST = 0.15  # of an edge where views differ by ``DISAGREEMENT``
MAX_VIEWS = 4  # views whose mean is a position's detail ...
NOISE_FACTOR = 4.0  # ... where they differ from the chosen one by no more than this, by the median over the head
SWEEPS = 8  # of belief propagation
CANDIDATES = 6  # views of a vertex that come into question; a seventh is hardly ever the best
GAIN_COST = 1.0  # of a camera whose light was doubled or halved
NOISE_CODES = 2.0  # disagreement that noise makes in the dark


def select_views(
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    levelled: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    gains: Float[np.ndarray, "k 3"],
    *,
    around: Neighbourhood,
    seam_cost: float = SEAM_COST,
) -> tuple[Int32[np.ndarray, " v"], Int32[np.ndarray, "v c"], Float32[np.ndarray, "v c"]]:
    """Chooses a view for each vertex, -1 where none sees it. Also returns the candidate views of each vertex and their
    quality.

    ``weights``: of the views by angle and distance, 0 = not seen. ``codes``: sRGB codes of every view at every vertex,
    gains applied. ``levelled``: the same after ``pipeline.texturing.seam_levelling``, which does not remove the edge of
    a shadow. ``agreed``: codes on which the views agree. ``gains``: of the cameras; their product is 1. ``around``: the
    mesh's edges. ``seam_cost``: of an edge where views differ.
    """
    quality = ring_quality(weights, around.starts, around.indices)
    best = quality.max(axis=1, keepdims=True)
    costs = 1.0 - quality / np.maximum(best, 1e-12)
    off = np.maximum(_disagreement(codes, agreed), _disagreement(levelled, agreed))
    costs += OUTLIER_COST * off**2 / (1.0 + off**2)
    costs += GAIN_COST * np.abs(np.log2(gains.mean(axis=1)))
    costs = np.where(weights.T > 0, costs, NEVER).astype(np.float32)
    views, candidates = best_candidates(costs, min(CANDIDATES, len(weights)))
    share = np.where(weights.T > 0, quality, 0.0)
    spread = (share * off).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-12)
    unlike = np.minimum(spread, 3.0)
    penalty = seam_cost * (0.3 + 0.5 * (unlike[around.rows] + unlike[around.indices]))
    chosen = propagate(
        views, candidates, around.starts, around.indices, around.opposite, penalty.astype(np.float32), len(weights),
        SWEEPS,
    )  # fmt: skip
    found = np.take_along_axis(views, np.maximum(chosen, 0)[:, None], axis=1)[:, 0]
    labels = np.where(chosen >= 0, found, -1).astype(np.int32)
    return labels, views, np.where(views >= 0, np.take_along_axis(quality, np.maximum(views, 0), axis=1), 0.0)


def _disagreement(
    codes: Float32[np.ndarray, "k v 3"], agreed: Float32[np.ndarray, "v 3"]
) -> Float32[np.ndarray, "v k"]:
    """Returns how far each view is from the others, relative to the usual difference."""
    off = (codes - agreed) / (DISAGREEMENT * agreed + NOISE_CODES)
    return np.sqrt(np.einsum("kvc,kvc->vk", off, off) / 3.0)


def add_similar_views(
    labels: Int32[np.ndarray, " v"],
    views: Int32[np.ndarray, "v c"],
    quality: Float32[np.ndarray, "v c"],
    detail: Float32[np.ndarray, "k v 3"],
    weights: Float32[np.ndarray, "k v"],
    *,
    around: Neighbourhood,
) -> tuple[Int32[np.ndarray, "v s"], Float32[np.ndarray, "v s"]]:
    """Adds to the chosen view of each vertex other views that differ from it by noise alone, so that their mean has
    less noise. Views that differ by more, as in eyes, brows and lips, are left out, since blending them would blur.

    Args:
        labels: the chosen view of each vertex, -1 = none.
        views: the candidate views of each vertex.
        quality: of the candidate views.
        detail: sRGB codes of the levelled views.
        weights: how well each view sees each vertex; 0 = not seen.
        around: the mesh's edges.

    Returns:
        Views (-1: none) and their shares in the mean, the chosen one first.
    """
    off = differences(labels, views, detail, weights, around.starts, around.indices)
    informative = off[(off >= 0) & (views != labels[:, None])]
    noise = max(float(np.median(informative)), 0.25) if len(informative) else 1.0
    best = np.maximum(quality.max(axis=1, keepdims=True), 1e-12)
    shares = (quality / best) * np.exp(-np.maximum(off / (NOISE_FACTOR * noise) - 1.0, 0.0))
    shares = np.where((off >= 0) & (labels[:, None] >= 0), shares, 0.0).astype(np.float32)
    return fill_slots(labels, views, shares, MAX_VIEWS)
