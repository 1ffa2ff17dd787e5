"""Faces for the tests of the finder: one that is drawn, which the networks take for a face, and points as detections.

Drawn, so that no picture of a person lies in the repository; the score (43) is a real face's.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import CROP_OF_FACE, FaceDetection, crop_around
from pipeline.faces.points import direction_from_face, point_table, view_bias
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
    """The mean adult's points as a finder would see them, the network's bias included; ``flat``: on a poster."""
    shape = point_table().shape_mm * ((1.0, 1.0, 0.0) if flat else (1.0, 1.0, 1.0))
    projected = camera.project(world_from_face.apply(shape)) + shift_px + rng.normal(0.0, noise_px, (len(shape), 2))
    bias = view_bias(direction_from_face(world_from_face, camera))
    points = projected
    for _ in range(4):  # the bias goes by the size and roll of the points that it moves
        crop = crop_around(points)
        points = projected + turned_about(bias, crop.roll_deg) * crop.side_px / CROP_OF_FACE
    box = np.concatenate([points.min(axis=0), points.max(axis=0)])
    return FaceDetection(points, score, box, crop_around(points).roll_deg)


PAINT_PX_PER_MM = 2.0  # of the drawing that is laid on a head or a poster
PAINT_MIDDLE = (300.0, 300.0)  # px of that drawing, where the face's middle is
DEPTH_ROUNDS = 12  # of the search for where a ray meets the relief; it halves its error each time
EYES_MM = ((-33.0, 20.0), (33.0, 20.0))  # x to the subject's left, y up: the drawn eyes' middles, the right one first


def photographed_face(camera: Camera, world_from_face: Similarity, *, flat: bool = False) -> ImageRgb:
    """A camera's picture of the drawn face on a head (its relief: an ellipsoid with a nose), or on a flat poster.

    Face frame: origin between the ears, z out of the face. From behind there is hair.
    """
    k = camera.intrinsics
    columns, rows = np.meshgrid(np.arange(k.width), np.arange(k.height))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float)
    face_from_world = world_from_face.inverse()
    start = face_from_world.apply(camera.centre_world[None])[0]
    rays = camera.rays_world(pixels) @ face_from_world.rotation.T
    image = np.tile(np.array(WALL, np.float32), (len(pixels), 1))
    if start[2] <= 0.0 and flat:
        return np.rint(image).astype(np.uint8).reshape(k.height, k.width, 3)
    if not flat:
        along, meets = _on_ellipsoid(start, rays)
        image[meets] = HAIR
        points = start + along[:, None] * rays
        for _ in range(DEPTH_ROUNDS):
            beside = np.where(meets, relief_mm(points[:, 0], points[:, 1]) - points[:, 2], 0.0)
            along = along + 0.5 * beside / np.where(np.abs(rays[:, 2]) > 0.2, rays[:, 2], np.inf)
            points = start + along[:, None] * rays
        shown = meets & (np.abs(relief_mm(points[:, 0], points[:, 1]) - points[:, 2]) < 1.0) & (points[:, 2] > 5.0)
        shown &= rays[:, 2] < -0.1
    else:
        points = start - (start[2] / np.where(np.abs(rays[:, 2]) > 1e-6, rays[:, 2], np.nan))[:, None] * rays
        shown = (np.abs(points[:, 0]) < 140.0) & (np.abs(points[:, 1]) < 140.0)
    paint = drawn_face(600, 600, (PAINT_MIDDLE,), scale=PAINT_PX_PER_MM)
    places = (points[:, :2] * (PAINT_PX_PER_MM, -PAINT_PX_PER_MM) + PAINT_MIDDLE).astype(np.float32)
    across, down = np.nan_to_num(places, nan=-1.0).T.reshape(2, k.height, k.width)
    painted = cv2.remap(paint, across, down, cv2.INTER_LINEAR).reshape(-1, 3)
    light = np.float32(1.0) if flat else _light(points)[:, None]
    image[shown] = (painted * light)[shown]
    smooth = cv2.GaussianBlur(image.reshape(k.height, k.width, 3), (0, 0), 0.7)
    return np.rint(np.clip(smooth, 0, 255)).astype(np.uint8)


SEMI_AXES_MM = (80.0, 115.0, 95.0)


def relief_mm(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Depth of the drawn head's front (z) by place (x, y), mm."""
    a, b, c = SEMI_AXES_MM
    front = c * np.sqrt(np.maximum(1.0 - (x / a) ** 2 - (y / b) ** 2, 0.0))
    nose = 24.0 * np.exp(-((x / 11.0) ** 2) - np.where(y > -18.0, ((y + 18.0) / 22.0) ** 2, ((y + 18.0) / 7.0) ** 2))
    sockets = sum(-7.0 * np.exp(-(((x - ex) / 15.0) ** 2) - ((y - ey) / 12.0) ** 2) for ex, ey in EYES_MM)
    return front + nose + sockets


def _on_ellipsoid(
    start: Float[np.ndarray, " 3"], rays: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], np.ndarray]:
    """How far along each ray the head's ellipsoid begins, and whether it is met."""
    p, d = start / SEMI_AXES_MM, rays / SEMI_AXES_MM
    square, middle = (d**2).sum(axis=1), d @ p
    root = middle**2 - square * (p @ p - 1.0)
    return (-middle - np.sqrt(np.maximum(root, 0.0))) / square, root > 0.0


def _light(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Shading by a lamp above on the right of the subject."""
    x, y = points[:, 0], points[:, 1]
    slope_x = (relief_mm(x + 0.5, y) - relief_mm(x - 0.5, y)).astype(np.float32)
    slope_y = (relief_mm(x, y + 0.5) - relief_mm(x, y - 0.5)).astype(np.float32)
    cosine = (0.35 * slope_x - 0.45 * slope_y + 1.0) / np.sqrt(1.0 + slope_x**2 + slope_y**2) / 1.15
    return np.clip(0.45 + 0.65 * np.maximum(cosine, 0.0), 0.0, 1.25).astype(np.float32)
