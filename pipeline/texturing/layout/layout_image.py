"""Continues images in a texture layout beyond its borders, since renderers also read neighbouring texels."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32


def spread_texels(image: Float32[np.ndarray, "s s k"], known: Bool[np.ndarray, "s s"]) -> Float32[np.ndarray, "s s k"]:
    """Returns the image with every unknown texel replaced by the nearest known one."""
    _, labels = cv2.distanceTransformWithLabels(
        (~known).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(labels).astype(np.int32)
    values = np.ones((int(nearest.max()) + 1, image.shape[2]), np.float32)
    values[nearest[known]] = image[known]
    return values[nearest]
