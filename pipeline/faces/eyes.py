"""Finds the irises and the lids' edges of a detected face in one picture.

The network for eyes has a higher resolution than the network for the face's 468 landmarks. The network for eyes follows
the visible edges of the lids, whereas the landmarks are biased towards the opening of an average eye.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import Crop, FaceDetection, Pyramid, in_picture
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.networks import EYE_SIZE, FaceNetworks
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS, direction_from_face
from rig.messages.message import Message, compose
from rig.rig import Rig

CROP_OF_WIDTH = 2.3  # side of an eye's crop by the distance of its corners, as the network was trained
LIDS = {"right": slice(0, 16), "left": slice(16, 32)}  # rows of ``FaceDetection.lids_px``
INNER, LOWER, UPPER = 8, slice(1, 8), slice(9, 16)  # of one eye's lids: its inner corner, and edges but for corners
OPENING_VIEWS = 4  # the most frontal ones

MIN_HALF_OPENING, MAX_CLOSED_OPENING = 0.095, 0.1  # of lids that are half closed (0.108), and of lids that meet (0.093)


def find_eyes(pyramid: Pyramid, face: FaceDetection, networks: FaceNetworks) -> FaceDetection:
    """Adds irises and lid edges (px of the picture) to a detected face. Both eyes of the face must be visible."""
    right = _place(pyramid, face.landmarks_px[list(RIGHT_EYE_CORNERS)], networks, mirrored=False)
    left = _place(pyramid, face.landmarks_px[list(LEFT_EYE_CORNERS)], networks, mirrored=True)
    lids, irises = (np.concatenate(pair) for pair in zip(right, left, strict=True))
    return replace(face, irises_px=irises, lids_px=lids)


def eye_openings(face: MatchedFaces, rig: Rig) -> dict[str, float]:
    """Returns the opening of each eye (``right``, ``left``): the mean gap between its lids divided by the eye's length,
    as the median over the most frontal views. An eye is left out if its lids were found in no view.

    On rendered heads, open eyes have 0.19 to 0.24, half-closed eyes 0.108 to 0.177, and closed eyes 0.025 to 0.093. On
    six path-traced and scanned people, open eyes have 0.18 to 0.27 and closed eyes 0.03 to 0.05.
    """
    facing = {name: direction_from_face(face.world_from_face, rig[name]) for name in face.detections}
    frontal = sorted(facing, key=lambda name: -facing[name][2])
    openings: dict[str, float] = {}
    for side, rows in LIDS.items():
        views = [
            opening_of(lids[rows], facing[name])
            for name in frontal
            if (lids := face.detections[name].lids_px) is not None
        ]
        if views:
            openings[side] = float(np.median(views[:OPENING_VIEWS]))
    return openings


def closed_by_openings(openings: Mapping[str, float]) -> frozenset[str]:
    """Returns the eyes that are closed according to their openings."""
    return frozenset(side for side, opening in openings.items() if opening < MIN_HALF_OPENING)


def eye_warnings(closed: Collection[str]) -> list[Message]:
    """Returns a warning if an eye is closed, since most studios then want another shot."""
    if not closed:
        return []
    both = len(closed) == 2
    return [compose("eyes-closed", eyes=compose("both-eyes-are") if both else compose("one-eye-is", side=min(closed)))]


def opening_of(lids_px: Float[np.ndarray, "16 2"], direction: Float[np.ndarray, " 3"]) -> float:
    """Returns the height of the gap between the lids divided by the eye's length, as if seen from the front."""
    across = lids_px[INNER] - lids_px[0]
    length = float(np.linalg.norm(across))
    normal = np.array([-across[1], across[0]]) / length
    gap = float(np.abs((lids_px[LOWER] - lids_px[UPPER]) @ normal).mean())
    x, y, _ = direction
    return gap / length * float(np.sqrt((1.0 - x * x) / (1.0 - y * y)))


def _place(
    pyramid: Pyramid, corners_px: Float[np.ndarray, "2 2"], networks: FaceNetworks, *, mirrored: bool
) -> tuple[Float[np.ndarray, "16 2"], Float[np.ndarray, "5 2"]]:
    """Returns lid edges and iris of the eye between two corners. A left eye is mirrored for the network."""
    across = (corners_px[1] - corners_px[0]) * (-1.0 if mirrored else 1.0)
    roll = float(np.rad2deg(np.arctan2(across[1], across[0])))
    crop = Crop(corners_px.mean(axis=0), CROP_OF_WIDTH * float(np.linalg.norm(across)), roll, mirrored)
    picture_from_crop = crop.picture_from_crop(EYE_SIZE)
    lids, iris = networks.place_eye(pyramid.sample(crop, EYE_SIZE))
    return in_picture(lids, picture_from_crop), in_picture(iris, picture_from_crop)
