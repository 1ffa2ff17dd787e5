"""Provides measured properties of the landmark network's 468 face points: symmetric pairs, mean shape, bias and noise.
``right`` and ``left`` are the subject's sides.

Each point was paired with the nearest point in the mirror image of a face (``python -m
tests.laboratory.model_packs.landmark_map``).
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from rig.camera import Camera
from rig.geometry import Similarity, rigid_fit

RIGHT_EYE_CORNERS, LEFT_EYE_CORNERS = (33, 133), (263, 362)  # outer, inner
NOSE_TIP, CHIN, FOREHEAD = 1, 152, 10
RIGHT_EYE_OUTLINE = (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173)
"""The edges of a right eye's lids, in the order of the eye's network: along the lower lid from the outer corner to the
inner one, then along the upper lid."""


@dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """Holds the measured properties of the landmark network's 468 points. Arrays are read-only.

    In the face frame x points to the subject's left, y up, and z out of the face. Noise is relative to the size of the
    face in the picture. The logarithm of the noise grows linearly with ``1 - cos`` of the angle between the point's
    normal and the direction to the camera.
    """

    mirror_images: Int[np.ndarray, " 468"]  # of each point; those of the midline are their own
    shape_mm: Float[np.ndarray, "468 3"]  # on a mean adult, about the mean of the points
    normals: Float[np.ndarray, "468 3"]  # of the skin there, unit
    view_bias: Float[np.ndarray, "8 468 2"]  # coefficients of ``view_terms``
    point_noise: Float[np.ndarray, " 2"]  # of each point by its own: seen straight on, growth from its normal on
    view_noise: Float[np.ndarray, " 2"]  # of a view's points together: of a face that looks here, growth as it turns


@cache
def point_table() -> PointTable:
    """Reads the ``PointTable`` that belongs to the networks, and caches it."""
    with np.load(Path(__file__).parent / "packs" / "points.npz", allow_pickle=False) as table:
        arrays = {name: table[name].astype(int if name == "mirror_images" else float) for name in table.files}
    for array in arrays.values():
        array.flags.writeable = False
    return PointTable(**arrays)


def view_terms(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 8"]:
    """Returns the eight polynomial terms, up to third order, of which the network's bias is a weighted sum.
    ``direction`` is the unit vector from the face to the camera (face frame)."""
    x, y, _ = direction
    return np.array([1.0, x, y, x * x, x * y, y * y, x**3, x * x * y])


def view_bias(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "468 2"]:
    """Returns the network's mean error at each point of a face seen from ``direction`` (unit vector, face frame). The
    error points right and down in a picture of the upright face, and is relative to the face's size."""
    return np.tensordot(view_terms(direction), point_table().view_bias, axes=1)


def place_face(points_world: Float[np.ndarray, "n 3"], which: slice = slice(None)) -> tuple[Similarity, float]:
    """Fits the mean face to the points with the indices ``which``. Returns the face's pose and scale (world_from_face),
    and the relief.

    The face's scale is fitted to breadth and height only. The relief is the depth of the points divided by the mean
    face's depth; a flat picture has 0.
    """
    shape = point_table().shape_mm[which]
    mean, middle = shape.mean(axis=0), points_world.mean(axis=0)
    rotation = rigid_fit(shape, points_world).rotation
    within = (points_world - middle) @ rotation
    flat, shape = within[:, :2], shape - mean
    scale = float((flat * shape[:, :2]).sum() / (shape[:, :2] ** 2).sum())
    relief = float((within[:, 2] @ shape[:, 2]) / (shape[:, 2] @ shape[:, 2]) / scale) if scale > 0.0 else 0.0
    return Similarity(scale, rotation, middle - scale * rotation @ mean), relief


def direction_from_face(world_from_face: Similarity, camera: Camera) -> Float[np.ndarray, " 3"]:
    """Returns the unit vector from a face to a camera, in the face frame."""
    towards = (camera.centre_world - world_from_face.translation) @ world_from_face.rotation
    return towards / np.linalg.norm(towards)
