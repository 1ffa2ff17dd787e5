"""Reconstructs a textured head from a capture (section 4): the order of the stages, for every caller."""

from dataclasses import replace

from pipeline.evidence.plausibility import refuse
from pipeline.results.reconstruction import Reconstruction
from pipeline.stages.alignment import Alignment, align_head
from pipeline.stages.bust import colour_bust, fuse_depth, push_out_hair, shape_bust
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import measure_depth
from pipeline.stages.evidence import judge_head
from pipeline.stages.faces import find_faces
from pipeline.stages.head_fit import HeadFit, fit_head, fit_outlines
from pipeline.stages.part_labels import PartLabels, find_worn_cap, label_parts
from pipeline.stages.pose_check import check_pose
from pipeline.stages.recorder import Recorder
from pipeline.stages.refined_head import refine_head
from pipeline.stages.texturing import texture_head
from pipeline.stages.views import Views, check_lenses, find_views
from rig.formats.meshes.usdz import check_usd


def fit_shape(
    run: Recorder, context: ReconstructionContext, views: Views, alignment: Alignment
) -> tuple[PartLabels, HeadFit]:
    """Fits the head to the outlines, labels the pixels as skin, hair or clothes, and then fits the head to the
    photographs."""
    cap = run(find_worn_cap, context, views, alignment)
    outlines = run(fit_outlines, context, views, alignment, cap)
    labels = run(label_parts, context, views, outlines.model, outlines.mesh_world, cap)
    return labels, run(fit_head, context, views, outlines, labels)


def reconstruct(context: ReconstructionContext) -> Reconstruction:
    """Reconstructs a textured head from one capture (paper, section 4). Reads and writes no files.

    Raises EigenheadError where there is no answer (too few usable views, feature points that determine nothing) or a
    warning has a code that ``settings.fail_on`` names, and Cancelled when ``context.progress`` does.
    """
    if "usdz" in context.settings.outputs.written:
        check_usd()
    run = Recorder(context.progress)
    views = run(find_views, context)
    with run.beside(check_lenses, context, views):
        faces = run(find_faces, context, views.capture)
        alignment = run(align_head, context, views, faces)
        labels, head = fit_shape(run, context, views, alignment)
    depth = run(measure_depth, context, views, head, labels)
    with run.beside(fuse_depth, context, views, head.mesh_world, labels, depth) as fused:
        refined = run(refine_head, context, views, faces, head, labels, depth)
    with run.beside(shape_bust, context, views, depth, refined, fused.product) as surface:
        texturing = run(texture_head, context, views, head, refined, labels)
        pose = run(check_pose, context, faces, alignment, head, refined)
        evidence = run(judge_head, context, views, faces, alignment, head, refined, texturing=texturing, pose=pose)
    bust = run(colour_bust, context, views, surface.product, texturing.capture)
    hair = run(push_out_hair, context, refined, bust)
    if any(warning.code == "pose-doubtful" for warning in run.warnings):  # of a refusal that was overruled, too
        pose = replace(pose, doubtful=True)
    refuse(run.warnings, context.settings.fail_on)
    context.progress("done", 1.0)
    return Reconstruction(
        context.model.name,
        context.model.sha256,
        context.settings,
        context.device.description if context.device else "cpu",
        context.capture.digests,
        views,
        faces,
        alignment,
        labels,
        head,
        refined,
        texturing,
        bust,
        hair,
        pose,
        evidence,
        warnings=run.warnings,
        seconds=run.seconds(),
    )
