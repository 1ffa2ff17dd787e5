"""Evaluates the final head: agreement with every camera, measurements, and expression."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from pipeline.contour_fit.expression_evidence import doubtful_weights, makes_face
from pipeline.contour_fit.fit import Fit
from pipeline.detail.blink import blinks_of, with_lids
from pipeline.detail.expression_reading import read_expression
from pipeline.detail.refine import DeformedSurface
from pipeline.evidence.camera_metrics import CameraFigures, measure_cameras, start_masks
from pipeline.evidence.expression import (
    MIN_SIGMA,
    READ_SIGMA,
    BlendshapeRig,
    Found,
    build_blendshape_rig,
    found_expressions,
    shut_eyes,
)
from pipeline.evidence.measurements import Landmark, Measurement, landmarks, measurements
from pipeline.evidence.plausibility import UnexplainedOutlines, plausibility_warnings, unexplained_outlines, unseen_face
from pipeline.evidence.pose import PoseEvidence, judge_pose, pupils
from pipeline.faces.eyes import MAX_CLOSED_OPENING, closed_by_openings, eye_warnings
from pipeline.faces.landmark_map import landmark_map
from pipeline.head_model.expressions import words
from pipeline.multiview.tangency import pixel_mm
from pipeline.stages.alignment import Alignment
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.recorder import Staged
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.texturing import Texturing
from pipeline.stages.views import Views
from rig.messages.message import compose

MIN_LIDS = 0.4  # of the way down: of 26 eyes with smaller weights 12 were open, 9 half closed and 5 closed
Masks = Mapping[str, Bool[np.ndarray, "h w"]]


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Holds the measured properties of the final head. Mappings by camera have an entry for every camera of the rig."""

    start_masks: Masks  # of the head that the fit started from
    fitted_masks: Masks
    cameras: Mapping[str, CameraFigures]
    landmarks: Mapping[str, Landmark]  # world frame
    measurements: Mapping[str, Measurement]
    expression: tuple[Found, ...]  # the face that the head makes, the strongest part first
    blendshape_rig: BlendshapeRig | None  # where the settings ask for it


def judge_head(
    context: ReconstructionContext,
    views: Views,
    faces: Faces,
    alignment: Alignment,
    head: HeadFit,
    refined: RefinedHead,
    *,
    texturing: Texturing,
    pose: PoseEvidence,
) -> Staged[Evidence]:
    """Measures the final head, and warns if it is not plausible.

    Refuses with UnexplainedOutlines if the head fits hardly any outline and no face in the photographs confirms its
    pose. The settings can allow a misfitting head, for subjects with long hair all around.
    """
    fit, model, rig, outputs = head.fit, head.model, context.rig, context.settings.outputs
    before = start_masks(model, alignment.world_from_head, rig)
    fitted = {name: np.isfinite(depth) for name, depth in texturing.depths.items()}
    cameras = measure_cameras(model, fit, views.silhouettes, rig, fitted, before)
    widths_px = {camera.name: camera.intrinsics.width for camera in rig}
    made, min_sigma, closed_eyes, doubtful = fit, MIN_SIGMA, frozenset[str](), head.doubtful
    if refined.displaced is not None:
        made, min_sigma, doubtful = fit_with_read_face(context, head, refined.displaced)
        closed_eyes = refined.displaced.closed_eyes
    expression = found_expressions(model, made, min_sigma)
    posed = outputs.neutral or outputs.morphs
    evidence = Evidence(
        before,
        fitted,
        cameras,
        landmarks(model, fit, refined.mesh_world.vertices),
        measurements(model, fit, refined.mesh_world.vertices) | pupils(faces.eyes),
        expression,
        build_blendshape_rig(model, fit.world_from_head, refined.mesh_world, expression) if posed else None,
    )
    warnings = plausibility_warnings(fit, model, cameras, widths_px)
    pixels_mm = {camera.name: pixel_mm(camera, fit.world_from_head.translation) for camera in rig}
    unexplained = None if pose.is_on_face else unexplained_outlines(cameras, pixels_mm)
    if unexplained is not None and context.settings.unexplained_outlines == "refuse":
        warnings.append(context.guards.refuse(UnexplainedOutlines(unexplained)))
    unseen = unseen_face(texturing.vertices.views, model.levels["full"].face_region)
    warnings += [warning for warning in (unexplained, unseen) if warning is not None]
    closed_eyes = confirmed_closed(shut_eyes(model, made) | closed_eyes, faces.eye_openings)
    if doubtful:
        names = [words(model.expressions.names[row]) for row in sorted(doubtful)]
        warnings.append(compose("expression-doubtful", expressions=names))
    return Staged(evidence, [*warnings, *eye_warnings(closed_eyes)])


def fit_with_read_face(
    context: ReconstructionContext, head: HeadFit, displaced: DeformedSurface
) -> tuple[Fit, float, frozenset[int]]:
    """Returns the fit with the expression from the deformed head. The function also returns how many standard
    deviations a weight must have to be reported, and the indices of doubtful expressions, which are left out.

    The expression is estimated again only if the fit has an expression. The lids always follow the measured points
    around the eye, if these determine the lids (``told_lids``).
    """
    fit, model = head.fit, head.model
    rows = blinks_of(model)
    lids = told_lids(
        {side: share for side, share in displaced.lids.items() if share != float(fit.coefficients[rows[side]])}
    )
    if not makes_face(fit.coefficients, model.posed):
        return with_lids(fit, model, lids), MIN_SIGMA, head.doubtful
    read = read_expression(
        fit,
        model,
        context.model,
        displaced.vertices,
        displaced.observed,
        eigenheads=min(context.settings.fitting.modes, len(context.model.modes)),
    )
    doubtful = head.doubtful | doubtful_weights(model, read.coefficients)
    coefficients = read.coefficients.copy()
    coefficients[[model.posed.start + row for row in doubtful]] = 0.0
    least_sigma = MIN_SIGMA if read is fit else READ_SIGMA
    return with_lids(replace(read, coefficients=coefficients), model, lids), least_sigma, doubtful


def told_lids(lids: Mapping[str, float]) -> dict[str, float]:
    """Returns how far each eye is closed (0 to 1), for the report. Values below ``MIN_LIDS`` become 0, which is
    open."""
    return {side: share if share >= MIN_LIDS else 0.0 for side, share in lids.items()}


def confirmed_closed(closed: frozenset[str], openings: Mapping[str, float]) -> frozenset[str]:
    """Returns which eyes are closed. The fitted head's result ``closed`` is corrected where the measured ``openings``
    are clear."""
    apart = {side for side, opening in openings.items() if opening > MAX_CLOSED_OPENING}
    return (closed | closed_by_openings(openings)) - apart


def check_pose(
    context: ReconstructionContext, faces: Faces, alignment: Alignment, head: HeadFit, refined: RefinedHead
) -> Staged[PoseEvidence]:
    """Compares the head's landmarks with the faces in the photographs, and the pose's cost with the cost of the second
    best pose."""
    evidence, warnings = judge_pose(
        refined.mesh_world,
        head.fit.world_from_head,
        context.rig,
        faces.subject,
        None if faces.subject is None else landmark_map(context.model),
        method=alignment.method,
        rival=alignment.rival,
    )
    return Staged(evidence, warnings)
