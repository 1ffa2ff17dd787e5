"""Computes aids for picking one feature point in several views: epipolar guides, the triangulated point, the model's
landmark.

The module's inputs are only a rig and pixels. An epipolar guide includes lens distortion, so it is a curve.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.alignment.feature_points import locate_features
from pipeline.geometry.registration.rigid import procrustes
from pipeline.multiview.triangulation import CLICK_NOISE_PX, NoPoint, triangulate
from rig.camera import Camera
from rig.messages.message import Message, compose
from rig.progress import Progress
from rig.rig import Rig
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext

Pixels = Mapping[str, Mapping[str, Float[np.ndarray, " 2"]]]  # point, camera
Landmarks = Mapping[str, Float[np.ndarray, " 3"]]  # head frame, mm
Picks = tuple[tuple[str, tuple[float, ...]], ...]  # camera, pixel

REACH_MM = 220.0  # a guide covers so much of the ray before and behind the rig's centre: heads stand there
SAMPLES = 45
POINTS_LEAST = 3  # points that place the model's landmarks
OUTSIDE = 0.25  # of the image: guides go so far beyond its rim


def guide(rig: Rig, source: str, pixel: Float[np.ndarray, " 2"], target: str) -> Float[np.ndarray, "n 2"]:
    """Computes the curve (px) at which the camera ``target`` sees the line of sight through a pixel of the camera
    ``source``. The curve is empty if the target sees nothing of the line of sight."""
    camera = rig[source]
    ray = camera.rays_world(np.asarray(pixel, float)[None])[0]
    middle = float((rig.centre_world() - camera.centre_world) @ ray)
    depths = np.linspace(max(middle - REACH_MM, 50.0), middle + REACH_MM, SAMPLES)
    projected = rig[target].project(camera.centre_world + depths[:, None] * ray)
    return projected[_near_image(rig[target], projected)]


@dataclass(frozen=True, slots=True)
class Located:
    """Holds the triangulation of one point from its picked pixels. ``position`` (world frame, mm) is None if the point
    cannot be triangulated."""

    position: Float[np.ndarray, " 3"] | None
    reprojected: dict[str, list[float]]
    off_px: dict[str, float]
    contradiction: Message | None


class Guides:
    """Computes the aids for picking feature points in the pictures of one rig. The class caches results and recomputes
    only those that a change affects, so the cost of a click does not grow with the number of points."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._located: dict[str, tuple[Picks, Located]] = {}
        self._curves: dict[tuple[str, tuple[float, ...], str], list[list[float]]] = {}
        self._predicted: tuple[object, dict[str, dict[str, list[float]]]] = (None, {})

    def helps(
        self, points: Pixels, landmarks: Landmarks, shown: Collection[str], views: Collection[str] | None = None
    ) -> JsonObject:
        """Computes the aids for picking feature points, by point and then by camera, in pixels.

        ``points``: the pixels picked so far; ``landmarks``: the model's (head frame, mm); ``shown``: points whose
        guides are needed; ``views``: cameras in which guides are needed (None: all). Returns ``guides``, the other
        views' lines of sight as curves; ``reprojected``, where the triangulated point is seen; ``off_px``, distance of
        the picked pixel from there; ``predicted``, where the model's landmarks would be; ``contradictions``, what a job
        would leave out of points whose pixels do not fit together.
        """
        targets = self._rig.names if views is None else [name for name in self._rig.names if name in views]
        located = {name: self._of(name, views) for name, views in points.items()}
        places = {name: landmark.position for name, landmark in located.items() if landmark.position is not None}
        picks = {(camera, tuple(pixel)) for name in shown for camera, pixel in points.get(name, {}).items()}
        self._curves = {key: curve for key, curve in self._curves.items() if key[:2] in picks}
        return {
            "guides": {name: self._guides(points[name], targets) for name in shown if name in points},
            "reprojected": {name: landmark.reprojected for name, landmark in located.items() if landmark.reprojected},
            "off_px": {name: landmark.off_px for name, landmark in located.items() if landmark.off_px},
            "predicted": self._predict(places, landmarks),
            "contradictions": {
                n: landmark.contradiction.document() for n, landmark in located.items() if landmark.contradiction
            },
        }

    def _of(self, name: str, views: Mapping[str, Float[np.ndarray, " 2"]]) -> Located:
        key = tuple((camera, tuple(pixel)) for camera, pixel in views.items())
        known, located = self._located.get(name, (None, None))
        if located is None or known != key:
            located = locate(self._rig, name, views)
            self._located[name] = (key, located)
        return located

    def _guides(
        self, views: Mapping[str, Float[np.ndarray, " 2"]], targets: Collection[str]
    ) -> dict[str, list[list[list[float]]]]:
        return {
            target: [self._curve(source, pixel, target) for source, pixel in views.items() if source != target]
            for target in targets
        }

    def _curve(self, source: str, pixel: Float[np.ndarray, " 2"], target: str) -> list[list[float]]:
        key = (source, tuple(pixel), target)
        if key not in self._curves:
            self._curves[key] = guide(self._rig, source, pixel, target).round(2).tolist()
        return self._curves[key]

    def _predict(
        self, places: Mapping[str, Float[np.ndarray, " 3"]], landmarks: Landmarks
    ) -> dict[str, dict[str, list[float]]]:
        key = (len(landmarks), {name: tuple(position) for name, position in places.items()})
        if self._predicted[0] != key:
            self._predicted = (key, predicted(self._rig, places, landmarks))
        return self._predicted[1]


def locate(rig: Rig, name: str, views: Mapping[str, Float[np.ndarray, " 2"]]) -> Located:
    """Triangulates one point from the pixels picked in several views, and finds the pixels that contradict the others,
    which a job would leave out."""
    try:
        landmark = triangulate(views, rig, noise_px=CLICK_NOISE_PX)
    except NoPoint:
        return Located(None, {}, {}, None)
    remarks = locate_features({name: views}, rig, noise_px=CLICK_NOISE_PX).remarks
    off = {camera: round(float(np.linalg.norm(r)), 2) for camera, r in landmark.residuals_px.items()}
    projected = _seen(rig, {name: landmark.position_world})[name]
    return Located(landmark.position_world, projected, off, _together(remarks))


def predicted(
    rig: Rig, located: Mapping[str, Float[np.ndarray, " 3"]], landmarks: Mapping[str, Float[np.ndarray, " 3"]]
) -> dict[str, dict[str, list[float]]]:
    """Predicts the pixels of the model's landmarks in every view. The points in ``located`` (world frame, mm) determine
    the mean head's pose. Returns nothing if fewer than three points are landmarks, or if they lie on a line."""
    names = [name for name in located if name in landmarks]
    if len(names) < POINTS_LEAST:
        return {}
    with suppress(ValueError):
        world_from_head = procrustes(
            np.array([landmarks[name] for name in names]), np.array([located[name] for name in names])
        )
        return _seen(rig, {name: world_from_head.apply(point[None])[0] for name, point in landmarks.items()})
    return {}


def nearest_views(rig: Rig, front: str, count: int) -> list[str]:
    """Returns the names of ``count`` cameras: ``front`` and the cameras with the most similar viewing directions."""
    axes = {camera.name: camera.camera_from_world.rotation[2] for camera in rig}
    return sorted(axes, key=lambda name: (name != front, -float(axes[name] @ axes[front])))[:count]


def mean_landmarks(context: WorkerContext, report: Progress, *, model: str, names: list[str]) -> dict[str, list[float]]:
    """Returns the landmarks of a model's mean head (head frame, mm). The function runs in a child process, since a head
    model is large."""
    from pipeline.head_model.model import load_model

    loaded = load_model(model)
    vertices = loaded.vertices(np.zeros(0))
    return {name: vertices[loaded.landmarks[name]].tolist() for name in names}


def _seen(rig: Rig, points: Mapping[str, Float[np.ndarray, " 3"]]) -> dict[str, dict[str, list[float]]]:
    """Returns the pixel of each point by camera; cameras whose pictures do not contain the point are left out."""
    places = np.array(list(points.values()))
    clicks: dict[str, dict[str, list[float]]] = {name: {} for name in points}
    for camera in rig:
        pixels = camera.project(places)
        for name, near, pixel in zip(points, _near_image(camera, pixels), pixels.round(2).tolist(), strict=True):
            if near:
                clicks[name][camera.name] = pixel
    return clicks


def _near_image(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> np.ndarray:
    size = np.array([camera.intrinsics.width, camera.intrinsics.height])
    with np.errstate(invalid="ignore"):
        near = (pixels > -OUTSIDE * size) & (pixels < (1 + OUTSIDE) * size)  # NaN is neither
    return np.asarray(near.all(axis=1))


def _together(remarks: tuple[Message, ...]) -> Message | None:
    """Joins all remarks to one message; returns None if there are no remarks."""
    return compose("several", messages=remarks) if len(remarks) > 1 else next(iter(remarks), None)
