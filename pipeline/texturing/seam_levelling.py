"""Computes what is added to each photograph so that photographs meet on the head without a visible step.

Waechter et al. (2014, section 4.3, after Lempitsky and Ivanov 2007) look for smooth additive corrections that make both
sides of every seam agree. These are determined only up to what all views have in common. Here the correction of a view
is a smooth field that brings it to the colour on which all views agree, wherever the view sees the head (a screened
Poisson equation). A view with a shadow or a highlight thus has no tint far from a seam either, and any views can be
blended. What remains at a seam (noise, detail) is blended over one ring of triangles (``pipeline.texturing.paint``).

Corrections are in sRGB codes, so that neither dark creases nor bright skin dominate.
"""

import numpy as np
from jaxtyping import Float32

from pipeline.compute.threads import in_threads
from pipeline.texturing.neighbourhood import Neighbourhood
from pipeline.texturing.view_selection_kernels import level_view

LEVELLING = 10.0  # weight of a correction's step along an edge, by one of a departure from the views' mean
SWEEPS, FACTOR = 25, 1.7  # over-relaxed: corrections are right to 0.1 code after them


def level_views(
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    around: Neighbourhood,
) -> Float32[np.ndarray, "k v 4"]:
    """Computes what is added to each view at each vertex (sRGB codes; the fourth channel is 0) so that neighbouring
    views meet without a visible step.

    Args:
        weights: how well each view sees each vertex; 0 = not seen.
        codes: sRGB codes of every view at every vertex.
        agreed: codes on which the views of each vertex agree.
        around: the mesh's edges.
    """
    fields = np.zeros((*weights.shape, 4), np.float32)
    fields[:, :, :3] = (agreed - codes) * (weights > 0)[:, :, None]

    def work(first: int, last: int) -> None:
        for k in range(first, last):
            level_view(fields[k], weights[k] > 0, around.starts, around.indices, LEVELLING, SWEEPS, FACTOR)

    in_threads(len(weights), work)
    return fields
