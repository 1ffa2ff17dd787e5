"""What helps to pick one point in several views: epipolar guides, the triangulated point, the model's landmark.

Pure functions of a rig and pixels; lens distortion is kept, so that a guide is a curve.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import TypedDict

import numpy as np
from jaxtyping import Float

from pipeline.alignment.procrustes import procrustes
from pipeline.multiview.triangulation import NoPoint, triangulate
from rig.camera import Camera
from rig.rig import Rig
from server.tasks.child import Bench, Report

Pixels = Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]]  # point, camera

REACH_MM = 220.0  # a guide covers so much of the ray before and behind the rig's centre: heads stand there
SAMPLES = 45
POINTS_LEAST = 3  # points that place the model's landmarks
OUTSIDE = 0.25  # of the image: guides go so far beyond its rim


def guide(rig: Rig, source: str, pixel: Float[np.ndarray, " 2"], target: str) -> Float[np.ndarray, "n 2"]:
    """Where ``target`` sees the ray of a pixel of ``source``: a curve in pixels, empty where it sees none of it."""
    camera = rig[source]
    ray = camera.rays_world(np.asarray(pixel, float)[None])[0]
    middle = float((rig.centre_world() - camera.centre_world) @ ray)
    depths = np.linspace(max(middle - REACH_MM, 50.0), middle + REACH_MM, SAMPLES)
    seen = rig[target].project(camera.centre_world + depths[:, None] * ray)
    return seen[_near_image(rig[target], seen)]


class Helps(TypedDict):
    """By point and camera: the curves of the other views' rays, where the triangulated point is seen, how far off (px)
    what was picked is, and where the model's landmarks would be."""

    guides: dict[str, dict[str, list[list[list[float]]]]]
    reprojected: dict[str, dict[str, list[float]]]
    off_px: dict[str, dict[str, float]]
    predicted: dict[str, dict[str, list[float]]]


def helps(rig: Rig, points: Pixels, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> Helps:
    guides: dict[str, dict[str, list[list[list[float]]]]] = {}
    reprojected: dict[str, dict[str, list[float]]] = {}
    off: dict[str, dict[str, float]] = {}
    located: dict[str, np.ndarray] = {}
    for name, views in points.items():
        guides[name] = {
            target: [
                guide(rig, source, pixel, target).round(2).tolist()
                for source, pixel in views.items()
                if source != target
            ]
            for target in rig.names
        }
        with suppress(NoPoint):
            found = triangulate(views, rig, noise_px=1.0)
            located[name] = found.position_world
            reprojected[name] = _seen(rig, found.position_world)
            off[name] = {camera: round(float(np.linalg.norm(r)), 2) for camera, r in found.residuals_px.items()}
    return {
        "guides": guides,
        "reprojected": reprojected,
        "off_px": off,
        "predicted": predicted(rig, located, landmarks),
    }


def predicted(
    rig: Rig, located: Mapping[str, Float[np.ndarray, " 3"]], landmarks: Mapping[str, Float[np.ndarray, " 3"]]
) -> dict[str, dict[str, list[float]]]:
    """The model's landmarks in every view, once three points that are not on a line place its mean head."""
    names = [name for name in located if name in landmarks]
    if len(names) < POINTS_LEAST:
        return {}
    with suppress(ValueError):
        world_from_head = procrustes(
            np.array([landmarks[name] for name in names]), np.array([located[name] for name in names])
        )
        return {name: _seen(rig, world_from_head.apply(point[None])[0]) for name, point in landmarks.items()}
    return {}


def nearest_views(rig: Rig, front: str, count: int) -> list[str]:
    """``front`` and the cameras that look from most nearly the same side."""
    axes = {camera.name: camera.camera_from_world.rotation[2] for camera in rig}
    return sorted(axes, key=lambda name: (name != front, -float(axes[name] @ axes[front])))[:count]


def mean_landmarks(bench: Bench, report: Report, *, model: str, names: list[str]) -> dict[str, list[float]]:
    """Landmarks of a model's mean head (head frame, mm); runs in a child, because a model is large."""
    from pipeline.eigenheads.model import load_model

    loaded = load_model(model)
    vertices = loaded.vertices(np.zeros(0))
    return {name: vertices[loaded.landmarks[name]].tolist() for name in names}


def _seen(rig: Rig, point: Float[np.ndarray, " 3"]) -> dict[str, list[float]]:
    pixels = {camera.name: camera.project(point[None]) for camera in rig}
    return {n: p[0].round(2).tolist() for n, p in pixels.items() if _near_image(rig[n], p)[0]}


def _near_image(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> np.ndarray:
    size = np.array([camera.intrinsics.width, camera.intrinsics.height])
    with np.errstate(invalid="ignore"):
        near = (pixels > -OUTSIDE * size) & (pixels < (1 + OUTSIDE) * size)  # NaN is neither
    return np.asarray(near.all(axis=1))
