"""Where the head is before its shape is known (section 4.2)."""

from dataclasses import dataclass

from pipeline.alignment.landmarks import feature_alignment
from pipeline.alignment.silhouette_search import search_alignment
from pipeline.diagnostics import ReportWarning
from pipeline.eigenheads.model import HeadModel
from pipeline.eigenheads.model_basis import model_basis
from pipeline.settings import Settings
from pipeline.stages.context import Progress, ReconstructionContext
from pipeline.stages.recorder import Staged, stage
from pipeline.stages.views import Views
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.rig import Rig


@dataclass(frozen=True, slots=True)
class Alignment:
    """The pose of the mean head, and the camera that the subject faces."""

    world_from_head: Similarity
    front: str


def front_camera(rig: Rig, settings: Settings) -> str:
    """Returns the camera that the subject faces: the stated one, or the middle of the fan. Raises EigenheadError."""
    if settings.front is None:
        return rig.front_camera()
    if settings.front not in rig:
        raise EigenheadError(f"front camera {settings.front!r} is not in the rig; it has {', '.join(rig.names)}")
    return settings.front


@stage("alignment")
def align_head(context: ReconstructionContext, views: Views) -> Staged[Alignment]:
    """Aligns the mean head to the views. Raises TooFewFeatures, NoSubject."""
    model = model_basis(context.model, context.settings)
    return align_to_views(model, views, context.rig, context.settings, progress=context.progress)


def align_to_views(
    model: HeadModel, views: Views, rig: Rig, settings: Settings, *, progress: Progress
) -> Staged[Alignment]:
    """Aligns the mean head to feature points where the capture has any, to the silhouettes otherwise."""
    front = front_camera(rig, settings)
    if not views.capture.features:
        pose = search_alignment(model, views.silhouettes, rig, settings, front=front, report=progress)
        return Staged(Alignment(pose, front))
    found = feature_alignment(model, views.capture.features, rig, settings.alignment)
    warnings = [ReportWarning("features", remark) for remark in found.remarks]
    return Staged(Alignment(found.world_from_head, front), warnings)
