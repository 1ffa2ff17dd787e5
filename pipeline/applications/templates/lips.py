"""Shuts the lips of a head without expression, and smooths the inner edge at which its mouth is open.

What photographs show of shut lips is a dark line, and the surface there is the model's: the lips of a fitted head may
lie some tenths of a millimetre apart, through which teeth would shine. A wider gap is an open mouth, and stays.
"""

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.sparse.csgraph import dijkstra

from pipeline.applications.templates.pivots import Points
from pipeline.head_model.subdivision import boundary_loops

PARTED_MM = 1.5  # lips further apart are open
PRESS_MM = 0.1  # by which shut lips overlap, so that no slit is left between the corners of their triangles
LIP_MM = 14.0  # from the inner edge over a lip to its skin
FADE_MM = 4.0  # over which a lip's shift fades to the skin about it
COLUMN_MM = 0.5  # width of the strips in which the gap is measured
SPREAD_COLUMNS = 5  # over which the widest gap counts: a triangle of a lip is as wide
SMOOTH_ROUNDS = 12  # of the inner edge; they take out scallops of four edges' length


def shut_lips(
    vertices: Float[np.ndarray, "v 3"], opened: Int[np.ndarray, "f 3"], landmarks: Points
) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices (head frame, mm) with the lips shut where they are nearly so. ``opened``: the triangles
    without those that close the mouth."""
    rim = min(
        boundary_loops(opened), key=lambda loop: np.linalg.norm(vertices[loop].mean(axis=0) - landmarks["stomion"])
    )
    out = vertices.copy()
    for _ in range(SMOOTH_ROUNDS):
        before, after = np.roll(out[rim], 1, axis=0), np.roll(out[rim], -1, axis=0)
        out[rim] = 0.5 * out[rim] + 0.25 * (before + after)
    upper, lower = _lips(out, opened, np.array(rim))
    x = out[:, 0]
    columns = np.arange(x[rim].min(), x[rim].max(), COLUMN_MM)
    edges = []
    for lip, side in ((upper, 1.0), (lower, -1.0)):
        edge = np.full(len(columns), np.inf)
        np.minimum.at(edge, np.clip(np.searchsorted(columns, x[lip]) - 1, 0, len(columns) - 1), side * out[lip, 1])
        known = np.isfinite(edge)
        edges.append(side * np.interp(columns, columns[known], edge[known]))
    gap = edges[0] - edges[1]
    shut = np.where((gap > -PRESS_MM) & (gap < PARTED_MM), gap + PRESS_MM, 0.0)
    shut = gaussian_filter1d(maximum_filter1d(shut, SPREAD_COLUMNS, mode="nearest"), 1.0, mode="nearest")
    for lip, edge, way in ((upper, edges[0], -0.5), (lower, edges[1], 0.5)):
        far = np.abs(out[lip, 1] - np.interp(x[lip], columns, edge))
        inside = (x[lip] > columns[0]) & (x[lip] < columns[-1])
        shift = np.interp(x[lip], columns, shut) * np.exp(-0.5 * (far / FADE_MM) ** 2)
        out[lip, 1] += way * np.where(inside, shift, 0.0)
    return out


def _lips(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rim: Int[np.ndarray, " r"]
) -> tuple[Int[np.ndarray, " u"], Int[np.ndarray, " l"]]:
    """Returns the rows of the upper and of the lower lip: each vertex belongs to the half of the inner edge that is
    nearer along the mesh."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    long = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    graph = sparse.csr_array((long, (ends[:, 0], ends[:, 1])), shape=(len(vertices), len(vertices)))
    start, end = sorted((int(vertices[rim, 0].argmin()), int(vertices[rim, 0].argmax())))
    halves = rim[start + 1 : end], np.concatenate([rim[end + 1 :], rim[:start]])
    away = [dijkstra(graph, directed=False, indices=half, min_only=True, limit=LIP_MM) for half in halves]
    found = [np.flatnonzero((away[k] < LIP_MM) & (away[k] < away[1 - k])) for k in (0, 1)]
    found.sort(key=lambda rows: -vertices[rows, 1].mean())
    return found[0], found[1]
