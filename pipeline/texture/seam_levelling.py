"""What is added to each vertex's photograph so that photographs meet without a step.

Waechter et al. (2014, section 4.3, after Lempitsky and Ivanov 2007) look for smooth additive corrections that make both
sides of every seam agree; those are determined but for what all views have wrong together. Here every vertex is also
drawn, weakly, to the colour that its views agree on, so that a view with a shadow or a shine does not keep its tint far
from a seam. What is left at a seam after that, noise and detail, is faded over one ring of triangles
(``pipeline.texture.paint``).

Corrections are in sRGB codes: neither dark creases nor bright skin then take more than their share.
"""

import numpy as np
from jaxtyping import Float32, Int32

from pipeline.texture.view_selection import Neighbourhood
from pipeline.texture.view_selection_kernels import level

SWEEPS, FACTOR = 60, 1.7  # over-relaxed: changes by less than 0.1 code after them


def level_seams(
    labels: Int32[np.ndarray, " v"],
    weights: Float32[np.ndarray, "k v"],
    codes: Float32[np.ndarray, "k v 3"],
    agreed: Float32[np.ndarray, "v 3"],
    around: Neighbourhood,
    smoothness: float,
) -> Float32[np.ndarray, "v 4"]:
    """Corrections of the vertices' own views, codes (a fourth channel is empty).

    Args:
        labels: the view of each vertex, -1 = none.
        weights: 0 where a view does not see a vertex.
        codes: of every view at every vertex.
        agreed: codes that the views of each vertex agree on.
        around: the mesh's edges.
        smoothness: how much dearer a difference along an edge is than one to ``agreed``.
    """
    vertex, known = np.arange(len(labels)), labels >= 0
    own = codes[np.maximum(labels, 0), vertex]
    aims = np.zeros((len(labels), 4), np.float32)
    aims[known, :3] = (agreed - own)[known]
    v, w = around.rows, around.indices
    both = known[v] & known[w]
    seam = both & (labels[v] != labels[w])
    steps = np.zeros((len(v), 4), np.float32)
    a, b = v[seam], w[seam]
    mine, theirs = labels[a], labels[b]
    # At each end that both views see, what one shows less than the other is what it must get more.
    at_a, at_b = (weights[theirs, a] > 0)[:, None], (weights[mine, b] > 0)[:, None]
    total = at_a * (codes[theirs, a] - codes[mine, a]) + at_b * (codes[theirs, b] - codes[mine, b])
    steps[seam, :3] = total / np.maximum(at_a.astype(np.float32) + at_b, 1)
    joined = both.copy()
    joined[np.flatnonzero(seam)[~(at_a | at_b)[:, 0]]] = False
    strengths = (smoothness * joined).astype(np.float32)
    trust = known.astype(np.float32)
    return level(aims, trust, steps, strengths, around.starts, around.indices, SWEEPS, FACTOR)
