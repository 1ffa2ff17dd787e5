"""Determines the pose and scale of the mean head before the shape is fitted (the paper's section 4.2)."""

from dataclasses import dataclass, replace
from typing import Literal

from pipeline.alignment.face_alignment import align_to_face, frontmost_camera
from pipeline.alignment.feature_checks import features_beside_face
from pipeline.alignment.landmarks import TooFewFeatures, WrongFeatures, align_by_features
from pipeline.alignment.silhouette_search import NoSubject, moved_to_hull, search_alignment, upright_axes
from pipeline.contour_fit.problem import LandmarkObservations
from pipeline.faces.landmark_map import landmark_map
from pipeline.head_model.gaussian_process import model_basis
from pipeline.head_model.model import HeadModel
from pipeline.multiview.upright import guessed_up
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.faces import Faces
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.messages.message import compose, say_once
from rig.progress import Progress
from rig.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Holds the pose of the mean head, the camera that the subject faces, and the method used.

    ``landmarks`` are the face landmarks that determined the pose, if any. ``rival`` is the extra cost of the second
    best pose, relative to the cost (0.1 = 10 %), if silhouettes determined the pose.
    """

    world_from_head: Similarity
    front: str
    method: Literal["features", "landmarks", "silhouettes"]
    landmarks: LandmarkObservations | None = None
    rival: float | None = None


def front_camera(rig: Rig, settings: Settings) -> str:
    """Returns the name of the camera that the subject faces. The result is the camera in the settings or, by default,
    the middle camera of the rig. Raises EigenheadError if the settings name a camera that the rig does not have."""
    if settings.front is None:
        return rig.front_camera()
    if settings.front not in rig:
        raise EigenheadError(compose("front-not-in-rig", front=f"{settings.front!r}", cameras=rig.names))
    return settings.front


def align_head(context: ReconstructionContext, views: Views, faces: Faces) -> Staged[Alignment]:
    """Aligns the mean head to the capture's feature points. Without feature points the function uses the subject's face
    in the photographs, and without a face the silhouettes. Refuses with TooFewFeatures, WrongFeatures, NoSubject."""
    model, rig, settings = model_basis(context.model, context.settings), context.rig, context.settings
    face = None if faces.subject is None else faces.subject.matched
    if views.capture.features and face is not None:
        places = landmark_map(context.model)
        beside = features_beside_face(views.capture.features, face, rig, context.model, places)
        if beside is not None:
            return _without_features(context, views, faces, WrongFeatures(beside))
    if views.capture.features or face is None:
        try:
            return align_to_views(model, views, rig, settings, progress=context.progress)
        except (TooFewFeatures, WrongFeatures) as refusal:
            return _without_features(context, views, faces, refusal)
        except NoSubject as refusal:
            front = front_camera(rig, settings)
            axes = upright_axes(guessed_up(rig), rig[front].centre_world - rig.centre_world())
            pose = Similarity(1.0, axes, rig.centre_world())
            return Staged(Alignment(pose, front, "silhouettes"), [context.guards.refuse(refusal)])
    found = align_to_face(model, face, landmark_map(context.model))
    pose = found.world_from_head
    if len(face.detections) == 1:  # one view does not tell the distance
        pose = moved_to_hull(pose, rig[next(iter(face.detections))], model, views.silhouettes, rig)
    front = settings.front or frontmost_camera(pose.rotation[:, 2], pose.translation, rig)
    return Staged(Alignment(pose, front, "landmarks", found.landmarks))


def _without_features(
    context: ReconstructionContext, views: Views, faces: Faces, refusal: EigenheadError
) -> Staged[Alignment]:
    """Refuses wrong feature points, or aligns the head without them if the guards allow this."""
    overruled = context.guards.refuse(refusal)
    bare = replace(views, capture=replace(views.capture, features={}))
    found = align_head(context, bare, faces)
    return Staged(found.product, [overruled, *found.warnings])


def align_to_views(
    model: HeadModel, views: Views, rig: Rig, settings: Settings, *, progress: Progress
) -> Staged[Alignment]:
    """Aligns the mean head to the capture's feature points or, without any, to the silhouettes. Raises TooFewFeatures,
    WrongFeatures, NoSubject."""
    front = front_camera(rig, settings)
    if not views.capture.features:
        stated = settings.front is not None
        found = search_alignment(model, views.silhouettes, rig, settings, front=front, stated=stated, report=progress)
        pose = found.world_from_head
        if not stated:
            front = frontmost_camera(pose.rotation[:, 2], pose.translation, rig)
        return Staged(Alignment(pose, front, "silhouettes", rival=found.rival))
    found = align_by_features(model, views.capture.features, rig)
    names = [*views.capture.features, *rig.names]
    warnings = [compose("features", remark=remark) for remark in say_once(found.remarks, names)]
    return Staged(Alignment(found.world_from_head, front, "features"), warnings)
