"""Faces for the tests of the finder: one that is drawn, which the networks take for a face, and points as detections.

Drawn, so that no picture of a person lies in the repository; the score (43) is a real face's.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection, crop_around
from pipeline.faces.points import point_table
from rig.camera import Camera
from rig.capture import ImageRgb
from rig.geometry import Similarity

Colour = tuple[float, float, float]
FINER = 2  # drawn larger, so that edges are smooth
SKIN, HAIR, WALL, LIPS = (200.0, 150.0, 125.0), (60.0, 40.0, 30.0), (90.0, 110.0, 120.0), (170.0, 80.0, 80.0)
WHITE, IRIS, PUPIL, SHADE = (240.0, 240.0, 240.0), (70.0, 45.0, 30.0), (10.0, 10.0, 10.0), (120.0, 80.0, 70.0)
OUTER_EYE_CORNERS = ((-50.0, -20.0), (50.0, -20.0))  # where they are drawn at scale 1, from the face's middle


def drawn_face(
    width: int = 640,
    height: int = 480,
    middles: Sequence[tuple[float, float]] = ((319.5, 239.5),),
    *,
    scale: float = 1.0,
    roll_deg: float = 0.0,
) -> ImageRgb:
    """A picture with faces of 220 px by ``scale`` from chin to crown about ``middles``, turned clockwise."""
    image = np.full((height * FINER, width * FINER, 3), WALL, np.float32)
    for middle in middles:
        _draw(image, np.array(middle), scale, roll_deg)
    smooth = cv2.GaussianBlur(image, (0, 0), FINER)
    return np.rint(cv2.resize(smooth, (width, height), interpolation=cv2.INTER_AREA)).astype(np.uint8)


def turned_about(points: Float[np.ndarray, "n 2"], roll_deg: float) -> Float[np.ndarray, "n 2"]:
    """Points turned clockwise in the picture about the origin."""
    turn = np.deg2rad(roll_deg)
    return points @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _draw(image: np.ndarray, middle: Float[np.ndarray, " 2"], scale: float, roll_deg: float) -> None:
    def blob(x: float, y: float, across: float, down: float, colour: Colour) -> None:
        at = turned_about(np.array([[x, y]]), roll_deg)[0] * scale + middle + 0.5
        axes = (round(across * scale * FINER), round(down * scale * FINER))
        centre = tuple(np.rint(at * FINER - 0.5).astype(int).tolist())
        cv2.ellipse(image, centre, axes, roll_deg, 0, 360, colour, -1, cv2.LINE_AA)

    blob(0, 130, 60, 80, _times(SKIN, 0.8))
    blob(0, -20, 92, 125, HAIR)
    blob(0, 0, 80, 110, SKIN)
    for side in (-1, 1):
        blob(33 * side, -20, 17, 8, WHITE)
        blob(33 * side, -20, 7.5, 7.5, IRIS)
        blob(33 * side, -20, 3, 3, PUPIL)
        blob(34 * side, -40, 22, 4, HAIR)
        blob(10 * side, 30, 5, 3, SHADE)
    blob(0, 10, 9, 30, _times(SKIN, 1.08))
    blob(0, 22, 14, 10, _times(SKIN, 0.95))
    blob(0, 58, 27, 8, LIPS)
    blob(0, 58, 26, 1.2, HAIR)


def _times(colour: Colour, factor: float) -> Colour:
    return colour[0] * factor, colour[1] * factor, colour[2] * factor


def seen_face(
    world_from_face: Similarity,
    camera: Camera,
    rng: np.random.Generator,
    *,
    noise_px: float = 1.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
    flat: bool = False,
    score: float = 30.0,
) -> FaceDetection:
    """The mean adult's points as a finder would see them; ``flat``: on a poster."""
    shape = point_table().shape_mm * ((1.0, 1.0, 0.0) if flat else (1.0, 1.0, 1.0))
    points = camera.project(world_from_face.apply(shape)) + shift_px + rng.normal(0.0, noise_px, (len(shape), 2))
    box = np.concatenate([points.min(axis=0), points.max(axis=0)])
    return FaceDetection(points, np.zeros(len(points)), score, box, crop_around(points).roll_deg)
