"""Locates the head by its face in the photographs, as the start of the search for masks."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.faces.networks import FaceNetworks, load_networks
from pipeline.faces.subject import find_subject
from rig.camera import Camera
from rig.capture import ImageRgb
from rig.rig import Rig

BEHIND_FACE_MM = 50.0  # from the middle of a mean face's skin to the middle of its head
SKULL_MM = 62.0  # radius about that middle that is head on everybody: half the breadth of a narrow skull
CHIN_MM, HAIR_MM = -90.0, 150.0  # of a mean head about its middle: above the chin, nothing is farther to the side but
# hair that stands out by 70 mm
UPRIGHT = 0.7  # sine of the angle between view and up


@dataclass(frozen=True, slots=True, eq=False)
class HeadSeed:
    """Holds the head's centre, upward direction and size (world frame, mm), and the face's landmarks (px) in the views
    that show the face."""

    centre_world: Float[np.ndarray, " 3"]
    up_world: Float[np.ndarray, " 3"]
    skull_mm: float
    landmarks_px: Mapping[str, Float[np.ndarray, "468 2"]]


def find_head_seed(images: Mapping[str, ImageRgb], rig: Rig) -> HeadSeed | None:
    """Finds the subject's head from the face in the photographs; None if fewer than two photographs agree on a face."""
    face = find_subject(images, rig, _networks()).matched
    if face is None or len(face.detections) < 2:  # one view does not tell the distance
        return None
    world_from_face = face.world_from_face
    centre = world_from_face.translation - world_from_face.scale * BEHIND_FACE_MM * face.facing_world
    landmarks = {name: found.landmarks_px for name, found in face.detections.items()}
    return HeadSeed(centre, world_from_face.rotation[:, 1], world_from_face.scale * SKULL_MM, landmarks)


def head_core(seed: HeadSeed, camera: Camera, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of a reduced image (``size``: height, width) that certainly show the head: a disc
    for the skull and the outline of the face."""
    core = np.zeros(size, np.uint8)
    scale = size[1] / camera.intrinsics.width
    centre_camera = camera.camera_from_world.apply(seed.centre_world)
    if centre_camera[2] > seed.skull_mm:
        middle = (camera.project(seed.centre_world[None])[0] + 0.5) * scale - 0.5
        radius = seed.skull_mm / centre_camera[2] * camera.intrinsics.fx * scale
        if np.isfinite(middle).all() and np.abs(middle).max() < 4 * max(size):
            cv2.circle(core, (round(float(middle[0])), round(float(middle[1]))), max(round(float(radius)), 1), 1, -1)
    if camera.name in seed.landmarks_px:
        outline = np.rint((seed.landmarks_px[camera.name] + 0.5) * scale - 0.5).astype(np.int32)
        cv2.fillConvexPoly(core, cv2.convexHull(outline), 1)
    return core.view(bool)


def beside_head(seed: HeadSeed, camera: Camera, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of a reduced image (``size``: height, width) that certainly do not show the subject:
    above the chin, and farther to the side than hair extends. The mask is empty if the camera is above or below the
    head."""
    centre_camera = camera.camera_from_world.apply(seed.centre_world)
    up = (camera.camera_from_world.rotation @ seed.up_world)[:2]
    if centre_camera[2] <= seed.skull_mm or np.linalg.norm(up) < UPRIGHT:
        return np.zeros(size, bool)
    up = up / np.linalg.norm(up)
    scale = size[1] / camera.intrinsics.width
    middle = (camera.project(seed.centre_world[None])[0] + 0.5) * scale - 0.5
    mm = centre_camera[2] / (camera.intrinsics.fx * scale)  # of a pixel at the head
    row, column = np.mgrid[: size[0], : size[1]]
    off = np.stack([column - middle[0], row - middle[1]], axis=-1) * mm * (SKULL_MM / seed.skull_mm)
    above, aside = off @ up, np.abs(off @ np.array([-up[1], up[0]]))
    return (above > CHIN_MM) & (aside > HAIR_MM)


def above_chin(seed: HeadSeed, camera: Camera, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of an image (``size``: height, width) that are not below the chin."""
    up_camera = camera.camera_from_world.rotation @ seed.up_world
    chin = seed.centre_world + CHIN_MM * seed.skull_mm / SKULL_MM * seed.up_world
    if camera.camera_from_world.apply(chin)[2] <= 0:
        return np.ones(size, bool)
    middle, up = camera.project(chin[None])[0], up_camera[:2]
    row, column = np.ogrid[: size[0], : size[1]]
    return (column - middle[0]) * up[0] + (row - middle[1]) * up[1] > 0


@cache
def _networks() -> FaceNetworks:
    return load_networks()
