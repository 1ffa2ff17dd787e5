"""Triangulates a face's points from its detections in several views.

The landmark network has a bias that depends on the viewing direction (``points.view_bias``). The bias of the detector
is subtracted once the face's pose is known. The more a point turns away from a camera, the larger is its noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.faces.detection import FaceDetection
from pipeline.faces.points import direction_from_face, place_face, point_table, view_bias
from pipeline.multiview.triangulation import NoPoint, TriangulatedPoints, triangulate_many
from rig.camera import Camera
from rig.geometry import Similarity
from rig.rig import Rig

ALL_POINTS = slice(None)
SOME_POINTS = slice(0, None, 13)  # of the 468: enough to tell whose they are
MAX_POINT_MISFIT = 3.0  # a residual by its noise, beyond which it counts as this much
ROUNDS = 2  # of how the face lies, and what follows from it


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedFace:
    """Holds triangulated points of one face, with each view's pixels and noise in the order of ``detections``.

    The errors ``noise_px`` and ``points.covariances`` are independent for each point; ``view_noise_px`` is an error
    common to all points of a view.
    """

    detections: Mapping[str, FaceDetection]
    pixels: Float[np.ndarray, "v n 2"]  # the points without the network's bias
    noise_px: Float[np.ndarray, "v n"]
    view_noise_px: Float[np.ndarray, " v"]
    points: TriangulatedPoints
    world_from_face: Similarity  # of a mean adult's points (``points.PointTable``)
    relief: float  # depth by a mean face's: 1, and 0 for a poster

    @property
    def misfits(self) -> dict[str, float]:
        """Returns, for each view, the RMS of residuals divided by their expected noise (1 for a correct match)."""
        variance = self.noise_px[..., None] ** 2 + self.view_noise_px[:, None, None] ** 2
        squares = (self.points.residuals_px**2 / variance).mean(axis=(1, 2))
        return dict(zip(self.detections, np.sqrt(squares).tolist(), strict=True))


def triangulate_face(
    detections: Mapping[str, FaceDetection], rig: Rig, which: slice = ALL_POINTS
) -> TriangulatedFace | None:
    """Triangulates the points ``which`` of a face from its detections by view, and fits a mean face to them. Returns
    None if the views do not determine the points."""
    cameras, faces = [rig[name] for name in detections], list(detections.values())
    pixels = np.stack([face.landmarks_px[which] for face in faces])
    sizes = np.array([face.size_px for face in faces])
    noise = np.tile(point_table().point_noise[0] * sizes[:, None], pixels.shape[1])
    try:
        found = triangulate_many(pixels, cameras, noise)
        for _ in range(ROUNDS):
            world_from_face, _ = place_face(found.positions_world, which)
            pixels = np.stack([unbiased_px(f, world_from_face, c)[which] for f, c in zip(faces, cameras, strict=True)])
            noise = _noise_px(sizes, found.positions_world, world_from_face, cameras, which)
            beyond = np.linalg.norm(found.residuals_px, axis=2) / (np.sqrt(2.0) * MAX_POINT_MISFIT * noise)
            noise = noise * np.maximum(beyond, 1.0)
            found = triangulate_many(pixels, cameras, noise, start=found.positions_world)
    except NoPoint:
        return None
    world_from_face, relief = place_face(found.positions_world, which)
    view_noise = np.array([view_noise_px(s, world_from_face, c) for s, c in zip(sizes, cameras, strict=True)])
    return TriangulatedFace(dict(detections), pixels, noise, view_noise, found, world_from_face, relief)


def unbiased_px(face: FaceDetection, world_from_face: Similarity, camera: Camera) -> Float[np.ndarray, "468 2"]:
    """Returns a detection's 468 points (px of the picture) without the network's bias for this pose of the face."""
    bias = face.size_px * view_bias(direction_from_face(world_from_face, camera))
    roll = np.deg2rad(face.roll_deg)
    picture_from_level = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    return face.landmarks_px - bias @ picture_from_level.T


def point_noise_px(
    size_px: float,
    points_world: Float[np.ndarray, "n 3"],
    world_from_face: Similarity,
    camera: Camera,
    which: slice = ALL_POINTS,
) -> Float[np.ndarray, " n"]:
    """Returns the standard deviation (px, along each axis) of the independent error of each point in a view. The error
    grows as the skin at the point turns away from the camera."""
    straight, growth = point_table().point_noise
    normals = point_table().normals[which] @ world_from_face.rotation.T
    towards = camera.centre_world - points_world
    cosine = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return straight * size_px * np.exp(growth * (1.0 - cosine))


def view_noise_px(size_px: float, world_from_face: Similarity, camera: Camera) -> float:
    """Returns the standard deviation (px, along each axis) of the error that all points of a view have in common."""
    straight, growth = point_table().view_noise
    return float(straight * size_px * np.exp(growth * (1.0 - direction_from_face(world_from_face, camera)[2])))


def shared_modes(face: TriangulatedFace, rig: Rig) -> Float[np.ndarray, "m n 3"]:
    """Returns the displacement (mm) of every point, for each view and image axis, if all pixels of the view are off by
    one standard deviation of the view's common error."""
    modes = []
    for name, noise, view_noise in zip(face.detections, face.noise_px, face.view_noise_px, strict=True):
        _, slopes = rig[name].project_with_jacobian(face.points.positions_world)
        gains = np.einsum("nij,nkj->kni", face.points.covariances, slopes) / noise[:, None] ** 2
        modes.append(view_noise * gains)
    return np.concatenate(modes)


def _noise_px(
    sizes_px: Float[np.ndarray, " v"],
    points_world: Float[np.ndarray, "n 3"],
    world_from_face: Similarity,
    cameras: Sequence[Camera],
    which: slice,
) -> Float[np.ndarray, "v n"]:
    """Returns ``point_noise_px`` for all views at once."""
    views = zip(sizes_px.tolist(), cameras, strict=True)
    return np.stack([point_noise_px(size, points_world, world_from_face, c, which) for size, c in views])
