"""Brings the cameras of another program, whose unit is unknown, to millimetres by a known length in the pictures.

Enters: a capture with its rig in any unit, and scale.json. Leaves: the rig scaled so that the length is right, and what
was done. Cameras that agree with the length within its uncertainty are not changed, since a calibration board is more
precise.
"""

from dataclasses import replace

import numpy as np

from calibration.scene.scale import Scale, find_tags_of_shot, scale_from_cameras, scale_from_points, scale_from_tags
from rig.capture import Capture
from rig.formats.cameras.scale_json import CameraDistance, KnownLength, PointDistance
from rig.formats.pictures.work_size import work_features
from rig.messages.message import Message, compose
from rig.rig import Rig

AGREES_SHARES = 3.0  # standard deviations of the known length
AGREES_LEAST = 0.002  # and at least this share: half a millimetre of a head


def scaled_by_length(capture: Capture, rig: Rig, full: Rig, known: KnownLength) -> tuple[Rig, list[Message]]:
    """Scales a rig so that a known length is right (mm). Returns the rig and a message of what was done. If the rig
    agrees with the length within the length's uncertainty, it is returned unchanged, without a message.

    Args:
        capture: pictures as ``rig`` took them.
        rig: the cameras, perhaps of pictures that were read at a smaller size.
        full: the cameras of the original files, in whose pixels points were picked.
        known: the length.

    Raises InputError if the pictures do not show the length.
    """
    scale = _scale(capture, rig, full, known)
    if abs(np.log(scale.factor)) <= max(AGREES_LEAST, AGREES_SHARES * scale.share):
        return replace(rig, scale_sigma=min(rig.scale_sigma, scale.share)), []
    return replace(times(rig, scale.factor), scale_sigma=scale.share), [
        compose("cameras-scaled", factor=scale.factor, scale=scale.provenance)
    ]


def times(rig: Rig, factor: float) -> Rig:
    """Returns the rig with all its lengths multiplied by ``factor`` and its covariances scaled accordingly."""
    grows = np.diag([1.0, 1.0, 1.0, factor, factor, factor])
    return replace(
        rig,
        cameras=tuple(
            replace(
                camera,
                camera_from_world=replace(
                    camera.camera_from_world, translation=camera.camera_from_world.translation * factor
                ),
                covariance=None if camera.covariance is None else grows @ camera.covariance @ grows,
            )
            for camera in rig
        ),
    )


def _scale(capture: Capture, rig: Rig, full: Rig, known: KnownLength) -> Scale:
    if isinstance(known, CameraDistance):
        return scale_from_cameras(rig, known)
    if isinstance(known, PointDistance):
        ends = {"first": known.first, "second": known.second}
        pixels = work_features(
            {end: {name: _undistorted(full, name, at) for name, at in views.items()} for end, views in ends.items()},
            full,
            rig,
        )
        return scale_from_points(rig, PointDistance(pixels["first"], pixels["second"], known.distance_mm))
    return scale_from_tags(rig, known, find_tags_of_shot(capture.images, known))


def _undistorted(full: Rig, name: str, pixel: np.ndarray) -> np.ndarray:
    """Returns the position of a file's pixel in the picture as it is read."""
    lens = full[name].recorded
    return pixel if lens is None else lens.undistorted(pixel[None], full[name].intrinsics.matrix())[0]
