"""Makes small pictures of what the rig's cameras see, for the operator's pages."""

import cv2
import numpy as np

from rig.image import ImageRgb

PREVIEW_WIDTH = 640  # pixels
PREVIEW_QUALITY = 80  # of JPEG, 0 to 100


def jpeg(image: ImageRgb, width: int = PREVIEW_WIDTH) -> bytes:
    """Encodes an RGB image as a JPEG file. An image wider than ``width`` pixels is reduced to that width."""
    small = reduced(image, width)
    done, data = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, PREVIEW_QUALITY])
    assert done
    return data.tobytes()


def reduced(image: ImageRgb, width: int) -> ImageRgb:
    """Returns an image no wider than ``width`` pixels; its proportions stay. A smaller image is returned as it is."""
    if image.shape[1] <= width:
        return image
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
