"""Defines silhouettes, and the paper's costs for differences between two silhouettes (section 4.3)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.special import ndtri

from rig.messages.message import Message

Mask = Bool[np.ndarray, "h w"]

CONTOUR_BLUR_PX = 1.0  # noise of a digital edge falls from 0.29 to 0.1 px; a bend of radius r shifts by 1 / (2 r)


@dataclass(frozen=True, slots=True)
class ViewQuality:
    """Holds whether a view's silhouette is usable, and the warnings about it. ``doubts`` are warnings that a clean
    plate or a mask would resolve; only views without plate and mask have them."""

    usable: bool = True
    contrast: float = float("inf")  # subject against background, in standard deviations of the noise
    cut_off: tuple[str, ...] = ()  # image borders that the subject crosses
    components: int = 1
    holes: int = 0
    warnings: tuple[Message, ...] = ()
    figures: Mapping[str, float | list[float]] = field(default_factory=dict)
    doubts: tuple[Message, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Silhouette:
    """Holds one camera's silhouette: the mask (True = subject) and the sub-pixel signed distance to its contour (px,
    negative inside)."""

    mask: Mask
    distance: Float32[np.ndarray, "h w"]
    quality: ViewQuality = ViewQuality()

    def judged(self, **quality: Any) -> "Silhouette":
        """Returns the silhouette with some attributes of its quality replaced."""
        return replace(self, quality=replace(self.quality, **quality))


def silhouette_from_mask(mask: Mask) -> Silhouette:
    """Builds the silhouette from a binary mask."""
    return Silhouette(mask, signed_distance(mask))


def signed_distance(mask: Mask) -> Float32[np.ndarray, "h w"]:
    """Returns the sub-pixel signed distance (px) to the contour of a binary mask, negative inside. If the mask has no
    contour, the distance is +-(h + w), farther than any pixel.

    Far from the contour the result is the Euclidean distance to the nearest pixel *centre* on the other side of the
    contour, minus half a pixel. Within two pixels of the contour, the Euclidean distance is wrong by 0.3 px, because
    the mask has steps. Near the contour, the distance d is computed from the mask after a Gaussian blur, which turns a
    straight edge into ``Phi(-d / s)``."""
    inside, outside = _distance_transforms(mask)
    far = float(sum(mask.shape))
    distance = np.clip(np.where(mask, 0.5 - inside, outside - 0.5), -far, far)
    band = np.abs(distance) < 3.0
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), CONTOUR_BLUR_PX, borderType=cv2.BORDER_REPLICATE)[band]
    spread = float(np.hypot(CONTOUR_BLUR_PX, 12**-0.5))  # a pixel integrates over its own square
    fine = -spread * ndtri(np.clip(blurred, 1e-4, 1.0 - 1e-4))
    trust = np.clip(3.0 - np.abs(fine) / CONTOUR_BLUR_PX, 0.0, 1.0)  # full within 2 sigma, none beyond 3
    distance[band] = trust * fine + (1.0 - trust) * distance[band]
    return distance.astype(np.float32)


def _distance_transforms(mask: Mask) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Returns the distance transforms ``D(S)`` and ``D(~S)`` of a mask S (px); ``D(S)`` is zero outside S, ``D(~S)``
    inside."""
    return _distance_transform(mask), _distance_transform(~mask)


def _distance_transform(mask: Mask) -> Float32[np.ndarray, "h w"]:
    """Computes the distance transform ``D(S)`` of a mask exactly, with the same result in every call. OpenCV's result
    can differ in the last bit between calls for pictures of less than 16384 pixels on one core, where it uses the
    library IPP. Squared distances between pixels are integers, so rounding the squared results gives exact values, up
    to 1400 px."""
    distance = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    squares = np.square(distance, dtype=np.float64)
    return np.sqrt(np.rint(squares, out=squares), out=squares).astype(np.float32)


def boundary_weights(observed: Mask) -> Float32[np.ndarray, "h w"]:
    """Returns the weights ``1 / d(i, j)^2`` of the paper's eq. (5), where ``d = D(S) + D(~S)`` is the distance (px)
    from the observed contour."""
    inside, outside = _distance_transforms(observed)
    # One of the two is zero at every pixel, the other at least one; a mask without a contour has no boundary at all.
    return (1.0 / np.maximum(inside + outside, 1.0) ** 2).astype(np.float32)


def boundary_weighted_xor(observed: Mask, model: Mask, weights: Float[np.ndarray, "h w"]) -> float:
    """Computes the paper's eq. (5): the sum of ``weights`` (from ``boundary_weights``) over the pixels in which two
    masks differ."""
    return float(weights[observed ^ model].sum(dtype=np.float64))
