"""Irises and lids of a face that was found.

Enters: a picture and a face in it. Leaves: the face with its irises and lids. The eye's network looks closer than the
landmarks' one: its lids follow the edge that is seen, where the 468 points keep to the mean eye's opening.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.faces.crops import Crop, Pyramid, in_picture
from pipeline.faces.detection import FaceDetection
from pipeline.faces.networks import EYE_SIZE, FaceNetworks
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS

CROP_OF_WIDTH = 2.3  # side of an eye's crop by the distance of its corners, as the network was trained


def find_eyes(pyramid: Pyramid, face: FaceDetection, networks: FaceNetworks) -> FaceDetection:
    """Places the irises and lids of a face whose eyes are both seen."""
    right = _place(pyramid, face.landmarks_px[list(RIGHT_EYE_CORNERS)], networks, mirrored=False)
    left = _place(pyramid, face.landmarks_px[list(LEFT_EYE_CORNERS)], networks, mirrored=True)
    lids, irises = (np.concatenate(pair) for pair in zip(right, left, strict=True))
    return replace(face, irises_px=irises, lids_px=lids)


def _place(
    pyramid: Pyramid, corners_px: Float[np.ndarray, "2 2"], networks: FaceNetworks, *, mirrored: bool
) -> tuple[Float[np.ndarray, "16 2"], Float[np.ndarray, "5 2"]]:
    """Lids and iris of the eye between two corners, outer and inner. The network knows right eyes only."""
    across = (corners_px[1] - corners_px[0]) * (-1.0 if mirrored else 1.0)
    roll = float(np.rad2deg(np.arctan2(across[1], across[0])))
    crop = Crop(corners_px.mean(axis=0), CROP_OF_WIDTH * float(np.linalg.norm(across)), roll, mirrored)
    picture_from_crop = crop.picture_from_crop(EYE_SIZE)
    lids, iris = networks.place_eye(pyramid.sample(crop, EYE_SIZE))
    return in_picture(lids, picture_from_crop), in_picture(iris, picture_from_crop)
