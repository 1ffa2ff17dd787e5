"""Computes how much views shift against each other when a surface moves along its normal.

An error in an image (noise, a highlight, the calibration) is a shift of some pixels. The error in depth is that shift
divided by the parallax. Lengths that were measured with one rig are carried to another by the ratio of their
parallaxes.
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
    """Returns the parallax of points on a surface: by how much two views shift against each other along the surface,
    for each millimetre that the surface moves along its normal. It is the root mean square over all pairs of views,
    weighted.

    ``points``: on a surface, mm. ``normals``: unit normals of the surface there. ``centres``: of the cameras, in the
    same frame. ``view``: the cameras that compare each point; -1 for none. ``value``: their weights; 0 for none.
    """
    towards = centres[np.maximum(view, 0)] - points[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    slides = towards - np.einsum("nvc,nc->nv", towards, normals)[:, :, None] * normals[:, None]
    share = value / np.maximum(value.sum(axis=1, keepdims=True), 1e-9)
    middle = np.einsum("nv,nvc->nc", share, slides)
    square = (share * ((slides - middle[:, None]) ** 2).sum(axis=2)).sum(axis=1)
    return np.sqrt(2.0 * square)


def depth_factor(found: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns how much larger the depth error is that an error in the images causes than with the usual rig (eleven
    cameras around a face, parallax ``USUAL``): the ratio of the parallaxes, at least 1. ``found`` is the parallax of
    each point."""
    return USUAL / np.clip(found, MIN_PARALLAX, USUAL)
