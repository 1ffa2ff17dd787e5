"""Finds points of the scene in two neighbouring views each, with cameras that are known.

SIFT keypoints of each view are matched with those of its neighbours. A match is kept if the cameras allow it: both
pixels lie close to the point where their rays pass each other. The points say what is near and what is far where
colours do not; a uniform backdrop has none.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.camera import Camera
from rig.rig import Rig

MAX_KEYPOINTS = 3000  # a view
MAX_WIDTH = 1400  # px: larger pictures are reduced, a pixel is not asked for here
NEIGHBOURS, MAX_ANGLE_DEG, MIN_ANGLE_DEG = 4, 50.0, 1.5  # of the rays at the subject; SIFT bears 30 degrees or so
RATIO = 0.75  # of the best match's distance to the second's (Lowe 2004 has 0.8)
MAX_MISS_PX = 1.5  # of the reduced picture


@dataclass(frozen=True, slots=True, eq=False)
class ScenePoints:
    """Holds points of the scene (world, mm) with their pixels. For each view, ``pixels`` lists the pixels of the points
    that it shows, and ``rows`` the indices of these points."""

    points: Float[np.ndarray, "n 3"]
    pixels: Mapping[str, Float[np.ndarray, "_ 2"]]
    rows: Mapping[str, np.ndarray]


def find_scene_points(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]], rig: Rig, *, report: Callable[[float], None] = lambda share: None
) -> ScenePoints:
    """Finds points of the scene by matching keypoints between every two neighbouring views. ``images`` are RGB, by
    camera name; ``report`` is called with the share that is done."""
    seen = {}
    for count, camera in enumerate(rig):
        report(0.5 * count / len(rig))
        seen[camera.name] = _keypoints(images[camera.name])
    points: list[np.ndarray] = []
    pixels: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    rows: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    total = 0
    pairs = neighbouring_pairs(rig)
    for count, (a, b) in enumerate(pairs):
        report(0.5 + 0.5 * count / max(1, len(pairs)))
        first, second = _matches(seen[a], seen[b])
        found, good = _where_rays_pass(rig[a], first, rig[b], second)
        points.append(found[good])
        indices = np.arange(total, total + np.count_nonzero(good))
        total += len(indices)
        for name, at in ((a, first), (b, second)):
            pixels[name].append(at[good])
            rows[name].append(indices)
    return ScenePoints(
        np.concatenate(points) if points else np.zeros((0, 3)),
        {name: np.concatenate(at) if at else np.zeros((0, 2)) for name, at in pixels.items()},
        {name: np.concatenate(row) if row else np.zeros(0, int) for name, row in rows.items()},
    )


def neighbouring_pairs(rig: Rig) -> list[tuple[str, str]]:
    """Returns the pairs of cameras that see the subject from nearly the same side."""
    away = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(away @ away.T, -1, 1)))
    np.fill_diagonal(angle, np.inf)
    pairs = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(rig))
        for j in np.argsort(angle[i])[:NEIGHBOURS]
        if angle[i, j] < MAX_ANGLE_DEG
    }
    return [(rig.names[i], rig.names[j]) for i, j in sorted(pairs)]


def _keypoints(image: UInt8[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels of keypoints in the full image, and their descriptors."""
    scale = min(1.0, MAX_WIDTH / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    found, descriptors = cv2.SIFT.create(nfeatures=MAX_KEYPOINTS).detectAndCompute(
        cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None
    )
    at = np.array([point.pt for point in found]).reshape(-1, 2)
    descriptors = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
    return (at + 0.5) / scale - 0.5, np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))


def _matches(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels in both images of keypoints that match mutually and pass the ratio test."""
    if min(len(first[0]), len(second[0])) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    likeness = first[1] @ second[1].T
    best = likeness.argmax(axis=1)
    row = np.arange(len(best))
    top = likeness[row, best]
    mutual = likeness.argmax(axis=0)[best] == row
    likeness[row, best] = -1
    next_best = likeness.max(axis=1)
    good = mutual & (2 - 2 * top < RATIO**2 * (2 - 2 * next_best))
    return first[0][good], second[0][best[good]]


def _where_rays_pass(
    a: Camera, first: Float[np.ndarray, "n 2"], b: Camera, second: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Returns the points halfway between the rays of two matched pixels, and which of them project near both pixels."""
    if not len(first):
        return np.zeros((0, 3)), np.zeros(0, bool)
    u, v = a.rays_world(first), b.rays_world(second)
    base = b.centre_world - a.centre_world
    cosine = (u * v).sum(axis=1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_u = (u @ base - cosine * (v @ base)) / sine2
    along_v = (cosine * (u @ base) - v @ base) / sine2
    points = 0.5 * (a.centre_world + along_u[:, None] * u + b.centre_world + along_v[:, None] * v)
    limit = MAX_MISS_PX * max(1.0, max(a.intrinsics.width, a.intrinsics.height) / MAX_WIDTH)
    good = (sine2 > np.sin(np.radians(MIN_ANGLE_DEG)) ** 2) & (along_u > 0) & (along_v > 0)
    for camera, at in ((a, first), (b, second)):
        with np.errstate(invalid="ignore"):
            good &= np.linalg.norm(camera.project(points) - at, axis=1) < limit
    return points, good
