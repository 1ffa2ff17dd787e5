"""How much views shift against each other when a surface moves along its normal.

What is wrong in an image (noise, a highlight, a calibration) is a shift of so many pixels; in depth it is that divided
by the parallax. Lengths that were measured before one rig hold before another by the ratio of their parallaxes.
"""

import numpy as np
from jaxtyping import Float, Int

USUAL = 0.70  # of eleven cameras around a face: median over its patches, 0.69 to 0.70 on five captures of two renderers
MIN_PARALLAX = 0.1  # cameras that stand nearer together say nothing of depth


def parallax(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    centres: Float[np.ndarray, "k 3"],
    view: Int[np.ndarray, "n v"],
    value: Float[np.ndarray, "n v"],
) -> Float[np.ndarray, " n"]:
    """Returns by how much (mm on the surface, as the views see it) two views of each point shift against each other for
    each mm along its normal: the root mean square over two views drawn by weight, the same twice included.

    Args:
        points: places on a surface, mm.
        normals: unit, of the surface there.
        centres: of the cameras, same frame.
        view: the cameras that compare a point; -1 for none.
        value: their weights; 0 for none.
    """
    towards = centres[np.maximum(view, 0)] - points[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    slides = towards - np.einsum("nvc,nc->nv", towards, normals)[:, :, None] * normals[:, None]
    share = value / np.maximum(value.sum(axis=1, keepdims=True), 1e-9)
    middle = np.einsum("nv,nvc->nc", share, slides)
    square = (share * ((slides - middle[:, None]) ** 2).sum(axis=2)).sum(axis=1)
    return np.sqrt(2.0 * square)


def depth_factor(found: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns how many times farther a shift in the images moves a depth than before the usual rig; at least 1."""
    return USUAL / np.clip(found, MIN_PARALLAX, USUAL)
