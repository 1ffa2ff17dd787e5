"""What is added to each photograph so that photographs meet without a step.

Waechter et al. (2014, section 4.3, after Lempitsky and Ivanov 2007) look for smooth additive corrections that make both
sides of every seam agree; those are determined but for what all views have wrong together. Here the correction of each
view is the smooth field that brings it to the colour on which all views agree, wherever it sees the head (screened
Poisson equation): a view with a shadow or a shine keeps no tint far from a seam either, and any views may be faded into
each other. What is left at a seam (noise, detail) is faded over one ring of triangles (``pipeline.texturing.paint``).

Corrections are in sRGB codes: neither dark creases nor bright skin then take more than their share.
"""

import numpy as np
from jaxtyping import Float32

from pipeline.compute.threads import in_threads
from pipeline.texturing.neighbourhood import Neighbourhood
from pipeline.texturing.view_selection_kernels import level_view

SWEEPS, FACTOR = 25, 1.7  # over-relaxed: corrections are right to 0.1 code after them


def level_views(
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    around: Neighbourhood,
    smoothness: float,
) -> Float32[np.ndarray, "k v 4"]:
    """Computes what is added to each view at each vertex (sRGB codes; the fourth channel is empty) so that neighbouring
    views meet without a step.

    Args:
        weights: 0 where a view does not see a vertex.
        codes: of every view at every vertex.
        agreed: codes that the views of each vertex agree on.
        around: the mesh's edges.
        smoothness: how much dearer a difference along an edge is than one to ``agreed``.
    """
    fields = np.zeros((*weights.shape, 4), np.float32)
    fields[:, :, :3] = (agreed - codes) * (weights > 0)[:, :, None]

    def work(first: int, last: int) -> None:
        for k in range(first, last):
            level_view(fields[k], weights[k] > 0, around.starts, around.indices, smoothness, SWEEPS, FACTOR)

    in_threads(len(weights), work)
    return fields
