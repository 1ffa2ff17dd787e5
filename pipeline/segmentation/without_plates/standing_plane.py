"""Finds what the subject stands on, or in front of: a plane with many scene points beyond which no part of the subject
lies.

A table of the subject's own colour is in front of all cameras like the subject, but it is flat and wide. It is found by
random samples (RANSAC, Fischler & Bolles 1981) from a fixed seed. A person on a chair has no such plane, and none is
found.
"""

import numpy as np
from jaxtyping import Float

TRIPLES, SAMPLES = 20000, 2000  # drawn; of those far enough apart, tried
OUTER, APART = 0.35, 0.4  # of the radius: how far from the middle, and from each other, the points of a sample are
NEAR = 0.012  # of the volume's radius: how far a point of the plane may be from it; 3 mm of a head's picture
MIN_POINTS, MIN_SHARE = 40, 0.08  # that lie on it; 0.11 of the Buddha's
MAX_BEYOND = 0.01  # share of the points within the volume that may lie on its other side
MIN_WIDTH = 0.45  # of the radius: root mean square distance of its points from their middle; of a face 0.25
OUTLYING, ROOM = 0.01, 1.2  # share of points that are wrong; of their distance, room for what shows none
MIN_OFF_CENTRE = 0.08  # of the radius: the place that all cameras look at is not on it


def standing_plane(
    points_world: Float[np.ndarray, "n 3"], centre_world: Float[np.ndarray, " 3"], radius_mm: float
) -> Float[np.ndarray, " 4"] | None:
    """Finds a plane that many scene points lie on and hardly any lie beyond. ``plane . (x, 1)`` is the distance (mm),
    positive on the subject's side; None if there is no such plane."""
    near = points_world[np.linalg.norm(points_world - centre_world, axis=1) < 2 * radius_mm]
    if len(near) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    best, most = None, 0
    outer = near[np.linalg.norm(near - centre_world, axis=1) > OUTER * radius_mm]
    if len(outer) < 3:
        return None
    triples = outer[rng.integers(len(outer), size=(TRIPLES, 3))]
    sides = np.linalg.norm(triples - np.roll(triples, 1, axis=1), axis=2).min(axis=1)
    for three in triples[sides > APART * radius_mm][:SAMPLES]:
        plane = _through(three, centre_world)
        if plane is None or plane[:3] @ centre_world + plane[3] < MIN_OFF_CENTRE * radius_mm:
            continue
        count = int((np.abs(near @ plane[:3] + plane[3]) < NEAR * radius_mm).sum())
        if count > most and _holds(plane, near, centre_world, radius_mm):
            best, most = plane, count
    return None if best is None else _refined(best, near, centre_world, radius_mm)


def ball_above(
    plane_world: Float[np.ndarray, " 4"],
    points_world: Float[np.ndarray, "n 3"],
    centre_world: Float[np.ndarray, " 3"],
    radius_mm: float,
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Returns the centre (world) and radius (mm) of a ball around the scene points above the plane, with some margin
    for parts without points."""
    height = points_world @ plane_world[:3] + plane_world[3]
    inside = np.linalg.norm(points_world - centre_world, axis=1) < radius_mm
    standing = points_world[inside & (height > 2 * NEAR * radius_mm)]
    if len(standing) < MIN_POINTS:
        return centre_world, radius_mm
    low, high = np.quantile(standing, (OUTLYING, 1 - OUTLYING), axis=0)
    middle = 0.5 * (low + high)
    away = np.linalg.norm(standing - middle, axis=1)
    return middle, min(radius_mm, ROOM * float(np.quantile(away, 1 - OUTLYING)))


def _holds(
    plane: Float[np.ndarray, " 4"], points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, " 3"], radius: float
) -> bool:
    height = points @ plane[:3] + plane[3]
    on = points[np.abs(height) < NEAR * radius]
    inside = np.linalg.norm(points - centre, axis=1) < radius
    if len(on) < max(MIN_POINTS, MIN_SHARE * len(points)):
        return False
    spread = np.sqrt(((on - on.mean(axis=0)) ** 2).sum(axis=1).mean())
    beyond = (height[inside] < -2 * NEAR * radius).mean() if inside.any() else 1.0
    return bool(spread > MIN_WIDTH * radius and beyond < MAX_BEYOND)


def _through(three: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 4"] | None:
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-9:
        return None
    plane = np.append(normal, -normal @ three[0]) / length
    return plane if plane[:3] @ centre + plane[3] > 0 else -plane


def _refined(
    plane: Float[np.ndarray, " 4"], points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, " 3"], radius: float
) -> Float[np.ndarray, " 4"]:
    """Returns the plane fitted by least squares to the points near it."""
    for _ in range(3):
        on = points[np.abs(points @ plane[:3] + plane[3]) < NEAR * radius]
        middle = on.mean(axis=0)
        normal = np.linalg.svd(on - middle)[2][2]
        plane = np.append(normal, -normal @ middle)
        plane = plane if plane[:3] @ centre + plane[3] > 0 else -plane
    return plane
