"""Finds the pupil in the views of an eye: the darkest disc in the iris, of the same size in all views.

Enters: the views, about where the pupil lies, and the plane it lies in. Leaves: its centre in each view. What mirrors a
lamp is left out. Brightness is taken by its square root, so that noise is alike in bright and dark.
"""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32

from pipeline.faces.limbus import EyeView

STEP_MM, HALF_MM, IRIS_MM = 0.2, 5.0, 4.5  # of the patch about the pupil, and the iris' inner part
REACH_MM = 2.4  # how far off the pupil may lie
RADII_MM = np.arange(1.0, 3.7, 0.3)
RING_MM, BETWEEN_MM = 0.9, 0.1  # a pupil is darker than the ring about it; neither has its edge
GLARE = 1.3  # by the iris' median: brighter than any of its fibres
MIN_DISC, MIN_RING = 0.5, 0.4  # shares that no highlight covers
MIN_CONTRAST = 0.2  # between ring and disc, by the iris' median; shade under lids has less
ALONG_MM = np.arange(-HALF_MM, HALF_MM + 1e-9, STEP_MM)
LACKING = -1.0  # contrast where there is none to be measured

Contrasts = Float32[np.ndarray, "r n n"]


def pupils_px(
    views: Sequence[EyeView], centre: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "2 3"]
) -> list[Float[np.ndarray, " 2"] | None]:
    """Returns the pupil's centre in each view (px of the picture), None where it is not clear.

    Args:
        views: of one eye.
        centre: where the pupil is looked for, world, to ``REACH_MM``.
        axes: two unit vectors in its plane.
    """
    contrasts = [_contrasts(view, centre, axes) for view in views]
    if not contrasts:
        return []
    size = int(np.sum([of.max(axis=(1, 2)) for of in contrasts], axis=0).argmax())
    out: list[Float[np.ndarray, " 2"] | None] = []
    for view, of in zip(views, contrasts, strict=True):
        place = _peak(of[size])
        out.append(None if place is None else view.camera.project((centre + place @ axes)[None])[0])
    return out


def _contrasts(view: EyeView, centre: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "2 3"]) -> Contrasts:
    """Returns by how much each disc, by its radius and place, is darker than the ring about it, by the iris."""
    across, up = np.meshgrid(ALONG_MM, ALONG_MM)
    places = centre + across.reshape(-1, 1) * axes[0] + up.reshape(-1, 1) * axes[1]
    x, y = (view.camera.project(places) - view.origin_px).T.astype(np.float32).reshape(2, *across.shape)
    patch = cv2.remap(view.brightness, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = np.sqrt(np.maximum(patch, 0.0))
    off = np.hypot(across, up)
    iris = max(float(np.median(level[off < IRIS_MM])), 1e-3)
    glare = cv2.dilate((level > GLARE * iris).astype(np.uint8), np.ones((5, 5), np.uint8))
    plain = 1.0 - glare.astype(np.float32)
    out = np.full((len(RADII_MM), *off.shape), LACKING, np.float32)
    for number, (disc, ring) in enumerate(_kernels()):
        (dark, inside), (bright, around) = (
            [cv2.filter2D(of, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT) for of in (plain * level, plain)]
            for kernel in (disc, ring)
        )
        clear = (inside > MIN_DISC * disc.sum()) & (around > MIN_RING * ring.sum()) & (off <= REACH_MM)
        contrast = bright / np.maximum(around, 1.0) - dark / np.maximum(inside, 1.0)
        out[number][clear] = contrast[clear] / iris
    return out


@lru_cache(maxsize=1)
def _kernels() -> list[tuple[Float32[np.ndarray, "k k"], Float32[np.ndarray, "k k"]]]:
    """Returns a disc of each radius and the ring about it."""
    out = []
    for radius in RADII_MM:
        count = int((radius + RING_MM) / STEP_MM) + 1
        off = np.hypot(*np.meshgrid(*[np.arange(-count, count + 1) * STEP_MM] * 2))
        ring = (off > radius + BETWEEN_MM) & (off <= radius + RING_MM)
        out.append(((off <= radius - BETWEEN_MM).astype(np.float32), ring.astype(np.float32)))
    return out


def _peak(contrast: Float32[np.ndarray, "n n"]) -> Float[np.ndarray, " 2"] | None:
    """Returns the place of the highest contrast (mm along both axes) between cells; None at the border of what could be
    measured, and where it is low."""
    row, column = np.unravel_index(contrast.argmax(), contrast.shape)
    about = contrast[row - 1 : row + 2, column - 1 : column + 2]
    if contrast[row, column] < MIN_CONTRAST or about.shape != (3, 3):
        return None
    lines = np.stack([about[1], about[:, 1]]).astype(float)
    bend = lines[:, 0] - 2.0 * lines[:, 1] + lines[:, 2]
    if (lines == LACKING).any() or (bend >= 0.0).any():
        return None
    shift = 0.5 * (lines[:, 0] - lines[:, 2]) / bend
    return ALONG_MM[[column, row]] + STEP_MM * shift
