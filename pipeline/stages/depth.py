"""Depth in every view from the photographs, and what of it is the fitted head's surface."""

from dataclasses import dataclass

from pipeline.dense.depth_map import DepthMap
from pipeline.dense.estimate import estimate_depth
from pipeline.dense.part_votes import PartVotes, vote_parts
from pipeline.dense.window_bias import WindowBias
from pipeline.fitting.fine.dense_points import dense_points
from pipeline.fitting.fine.depth_bias import OnFace, measure_bias, points_on_face
from pipeline.fitting.fine.surface_points import SurfacePoints
from pipeline.settings import FINE_LEVELS, Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged, stage
from pipeline.stages.views import Views


@dataclass(frozen=True, slots=True, eq=False)
class Depth:
    """Depth maps with what their pixels show, and the same as oriented points beside the fitted face."""

    maps: tuple[DepthMap, ...]  # none where no stage needs them
    votes: PartVotes | None
    points: SurfacePoints  # world frame, mm
    on_face: OnFace
    window_bias: WindowBias


def is_refined(head: HeadFit, settings: Settings) -> bool:
    """Returns whether the head is to be drawn to the dense surface: where photographs carried the fit itself."""
    return head.detail.level == "photo" and settings.detail in FINE_LEVELS


@stage("depth")
def measure_depth(context: ReconstructionContext, views: Views, head: HeadFit, labels: PartLabels) -> Staged[Depth]:
    """Measures depth in every view, bounded by the fitted head, where a later stage needs it."""
    settings, mesh = context.settings, head.mesh_world
    maps: tuple[DepthMap, ...] = ()
    if is_refined(head, settings) or settings.outputs.surface != "head":
        maps = estimate_depth(
            views.capture.images, views.silhouettes, context.rig, mesh, settings.dense, report=context.progress
        )
    votes = vote_parts(maps, labels.maps, context.rig)
    points = dense_points(maps, votes, mesh, settings.fine)
    on_face = points_on_face(points, mesh, head.model.levels["full"].face_region)
    return Staged(Depth(maps, votes, points, on_face, measure_bias(on_face)))
