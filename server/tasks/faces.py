"""Finds the faces in a capture's pictures, for the operator's pages; runs in a child process.

Pictures are read one after the other and reduced at once, because the networks use only 192 pixels of a face.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pipeline.faces.matching import EYE_DISTANCE_MM
from pipeline.faces.networks import load_networks
from pipeline.faces.sighting import file_pixels, reduce_picture
from pipeline.faces.subject import find_subject
from rig.camera import Camera
from rig.formats.captures.capture_folder import has_known_length, open_capture
from rig.formats.pictures.images import read_image
from rig.progress import Progress
from rig.rig import Rig
from server.storage.face_cache import PixelsOfPoints
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from pipeline.faces.detection import FaceDetection
    from pipeline.faces.matching import MatchedFaces
    from pipeline.faces.subject import SubjectFaces

PICTURE_PX = 1600  # longer side: a face of an eighth of it has the networks' 192 px


def find_capture_faces(
    context: WorkerContext, report: Progress, *, capture: str, images: Mapping[str, str]
) -> JsonObject:
    """Finds the faces in a capture's pictures, and which of them is the subject's. ``images``: file of each camera's
    picture, below the folder ``capture``. Raises InputError, and DamagedNetwork if a network's file is damaged."""
    root = Path(capture)
    _, read, _, _ = open_capture(root)
    recorded = read.rig
    pictures, cameras = {}, []
    for number, camera in enumerate(camera for camera in recorded if camera.name in images):
        report("read", number / len(images))
        image = read_image(root / images[camera.name])
        if camera.recorded is not None:
            image = camera.recorded.undistort(image, camera.intrinsics.matrix())
        pictures[camera.name], small = reduce_picture(image, camera, PICTURE_PX)
        cameras.append(small)
    rig = Rig(tuple(cameras))
    subject = find_subject(
        pictures,
        rig,
        context.keep("face networks", load_networks),
        eye_distance_mm=None if has_known_length(root) else EYE_DISTANCE_MM,
        report=lambda share: report("faces", share),
    )
    return describe(subject, rig, recorded, lambda face: _suggested(context, face, rig, recorded))


def describe(
    subject: "SubjectFaces", rig: Rig, recorded: Rig, suggest: "Callable[[MatchedFaces], PixelsOfPoints]"
) -> JsonObject:
    """Converts the faces found with the reduced cameras ``rig`` to pixels of the picture files, whose cameras are
    ``recorded``. The result has the ``faces`` of every picture, the subject's first, and the pixels ``suggested`` for
    the seven feature points, if any."""
    matched = subject.matched
    faces: dict[str, list[JsonObject]] = {}
    for name, seen in subject.found.items():
        best = None if matched is None else matched.detections.get(name)
        found = [_face_of(face, rig[name], recorded[name], best) for face in seen]
        faces[name] = sorted(found, key=lambda face: not face["is_subject"])
    return {"faces": faces, "suggested": {} if matched is None else suggest(matched)}


def _face_of(face: "FaceDetection", camera: Camera, recorded: Camera, best: "FaceDetection | None") -> JsonObject:
    """Describes one face in pixels of the picture's file. ``is_subject``: the views agree that it is the subject's
    face; ``roll_deg``: its clockwise rotation in the picture."""
    points = file_pixels(face.landmarks_px, camera, recorded)
    return {
        "box_px": _plain(np.concatenate([points.min(axis=0), points.max(axis=0)])),
        "roll_deg": round(face.roll_deg, 1),
        "score": round(face.score, 2),
        "is_subject": best is not None and face.landmarks_px is best.landmarks_px,
        "points": [_plain(point) for point in points],
    }


def _suggested(context: WorkerContext, face: "MatchedFaces", rig: Rig, recorded: Rig) -> PixelsOfPoints:
    """Returns the seven points from landmarks of the default model; empty if the face does not determine them."""
    from pipeline.alignment.feature_checks import suggest_points
    from pipeline.faces.landmark_map import NoLandmarkMap, landmark_map
    from pipeline.head_model.landmarks import SEVEN_POINTS
    from pipeline.head_model.model import load_model

    model = context.keep("model default", load_model)
    try:
        places = landmark_map(model)
    except NoLandmarkMap:
        return {}
    suggested = suggest_points(face, rig, model, places, SEVEN_POINTS)
    return {
        name: {c: _plain(file_pixels(pixel[None], rig[c], recorded[c])[0]) for c, pixel in views.items()}
        for name, views in suggested.items()
    }


def _plain(values: Float[np.ndarray, " n"]) -> list[float]:
    """Rounds pixel coordinates to a tenth."""
    return [round(float(value), 1) for value in values]
