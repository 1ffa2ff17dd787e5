"""Checks whether the delivered head lies where the photographs show the face."""

from dataclasses import replace

from pipeline.evidence.pose import PoseEvidence, judge_pose
from pipeline.faces.landmark_map import landmark_map
from pipeline.stages.alignment import Alignment
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.recorder import Staged
from pipeline.stages.refined_head import RefinedHead
from rig.messages.message import compose


def check_pose(
    context: ReconstructionContext, faces: Faces, alignment: Alignment, head: HeadFit, refined: RefinedHead
) -> Staged[PoseEvidence]:
    """Compares the head's landmarks with the faces in the photographs, and the cost of its pose with that of the best
    other pose."""
    evidence, warnings = judge_pose(
        refined.mesh_world,
        head.fit.world_from_head,
        context.rig,
        faces.subject,
        None if faces.subject is None else landmark_map(context.model),
        method=alignment.method,
        rival=alignment.rival,
    )
    if faces.contradicting:
        cameras = [view.camera for view in faces.contradicting]
        apart_mm = max(view.offset_mm for view in faces.contradicting)
        finding = compose("pose-of-moments", cameras=cameras, offset_mm=apart_mm)
        evidence, warnings = replace(evidence, doubtful=True), [*warnings, compose("pose-doubtful", finding=finding)]
    return Staged(evidence, warnings)
