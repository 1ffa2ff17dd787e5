"""Deforms the fitted head to the surface from dense stereo."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.posterior import vertex_deviation_mm
from pipeline.detail.depth_bias import remove_window_bias
from pipeline.detail.eyelids import measure_eye_appearance
from pipeline.detail.outline_points import pack_outlines
from pipeline.detail.patch_points import prepare_patch_search
from pipeline.detail.refine import MIN_OBSERVED_SHARE, DeformedSurface, refine_to_surface
from pipeline.fusion.untangling import untangle_head
from pipeline.photometric_fit.depth_search import head_depth_factor
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth, is_refined
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views
from pipeline.warnings import Detail
from rig.mesh import Mesh
from rig.messages.message import compose


@dataclass(frozen=True, slots=True, eq=False)
class RefinedHead:
    """Holds the final head mesh without degenerate triangles: the fitted head, perhaps deformed to the measured
    surface.

    ``deviation_mm`` is the posterior standard deviation of each vertex. ``displaced`` is the deformed surface; None if
    the head was not deformed.
    """

    mesh_world: Mesh  # full level, mm
    deviation_mm: Float[np.ndarray, " v"]
    detail: Detail
    displaced: DeformedSurface | None = None


def refine_head(
    context: ReconstructionContext, views: Views, faces: Faces, head: HeadFit, labels: PartLabels, depth: Depth
) -> Staged[RefinedHead]:
    """Deforms the fitted head to the measured surface. Returns the fitted head if the settings request less detail, or
    if too little of the face was measured."""
    settings, fit, model, mesh = context.settings, head.fit, head.model, head.mesh_world
    deviation_mm = vertex_deviation_mm(model, fit)
    if not is_refined(head, settings):
        return Staged(RefinedHead(*untangle_head(model, mesh.vertices, deviation_mm), head.detail))
    distances = {name: views.silhouettes[name].distance for name, used in fit.used.items() if used}
    cameras, face = [context.rig[name] for name in distances], np.flatnonzero(model.levels["full"].face_region)
    factor = head_depth_factor(mesh, face, cameras)
    hair = labels.hiding_probability()
    points = remove_window_bias(depth.points, depth.on_face, depth.window_bias)
    patches = prepare_patch_search(model, fit, depth.images, distances, hair, context.rig)
    displaced = refine_to_surface(
        fit,
        model,
        replace(points, deviation_mm=factor * points.deviation_mm),
        eigenheads=min(settings.fitting.modes, len(fit.coefficients)),
        deviation_mm=deviation_mm,
        eyes=measure_eye_appearance(model, mesh.vertices, views.capture.images, context.rig, faces.eye_openings),
        patches=patches,
        outlines=pack_outlines(model, patches.views, patches.cameras, hair),
        report=context.progress,
    )
    share, needed = float(displaced.observed[model.levels["full"].face_region].mean()), MIN_OBSERVED_SHARE
    if share < needed:
        reason = compose("level-surface-too-small", share=share, needed=needed)
        return Staged(RefinedHead(*untangle_head(model, mesh.vertices, deviation_mm), Detail("photo", reason)))
    detail = Detail("fine", compose("level-surface", share=share))
    refined = Mesh(displaced.vertices, mesh.faces)
    return Staged(RefinedHead(refined, displaced.deviation_mm, detail, displaced))
