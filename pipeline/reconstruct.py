"""Reconstructs a textured head from a capture (the paper's section 4) by calling the stages in their order."""

from collections.abc import Generator
from dataclasses import replace
from typing import Any

from pipeline.evidence.plausibility import refuse
from pipeline.results.reconstruction import Reconstruction
from pipeline.stages.alignment import Alignment, align_head
from pipeline.stages.bust import colour_bust, fuse_depth, push_out_hair, shape_bust
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import measure_depth
from pipeline.stages.evidence import check_pose, judge_head
from pipeline.stages.faces import find_faces
from pipeline.stages.head_fit import HeadFit, fit_head, fit_outlines
from pipeline.stages.part_labels import PartLabels, find_worn_cap, label_parts
from pipeline.stages.recorder import Recorder
from pipeline.stages.refined_head import refine_head
from pipeline.stages.texturing import texture_head
from pipeline.stages.views import Views, check_lenses, find_views
from rig.formats.meshes.usdz import check_usd


def fit_shape(run: Recorder, views: Views, alignment: Alignment) -> tuple[PartLabels, HeadFit]:
    """Fits the head to the outlines, labels the pixels as skin, hair or clothes, and then fits the head to the
    photographs."""
    with run.stage("alignment") as stage:
        cap = stage.keep(find_worn_cap(stage.context, views, alignment))
    with run.stage("fit") as stage:
        outlines = stage.keep(fit_outlines(stage.context, views, alignment, cap))
    with run.stage("parts") as stage:
        labels = stage.keep(label_parts(stage.context, views, outlines.model, outlines.mesh_world, cap))
    with run.stage("fit") as stage:
        return labels, stage.keep(fit_head(stage.context, views, outlines, labels))


def reconstruct(context: ReconstructionContext) -> Reconstruction:
    """Reconstructs a textured head from one capture (paper, section 4). The function reads and writes no files.

    Raises EigenheadError if no head can be computed, as with too few usable views, or if ``settings.fail_on`` names the
    code of a warning. Raises Cancelled if ``context.progress`` raises it.
    """
    steps = start_reconstruction(context)
    return steps.send(replace(next(steps), solution=None))  # which no later stage needs, and which is large


def start_reconstruction(context: ReconstructionContext, run: Recorder | None = None) -> Generator[Any, HeadFit, None]:
    """Runs a reconstruction, and yields the fitted head. The caller sends back a head, perhaps fitted to several
    captures; the generator continues with this head, and yields the result. ``run`` collects the warnings."""
    if "usdz" in context.settings.outputs.formats:
        check_usd()
    run = run or Recorder(context)
    with run.stage("segmentation") as stage:
        views = stage.keep(find_views(stage.context))
    with run.beside("segmentation", lambda quiet: check_lenses(quiet, views)):
        with run.stage("faces") as stage:
            faces = stage.keep(find_faces(stage.context, views.capture))
        with run.stage("alignment") as stage:
            alignment = stage.keep(align_head(stage.context, views, faces))
        labels, head = fit_shape(run, views, alignment)
    head = yield head
    with run.stage("depth") as stage:
        depth = stage.keep(measure_depth(stage.context, views, head, labels))
    handed_over, depth = [depth], replace(depth, maps=())  # the maps are large, and only fused
    with (
        run.beside("bust", lambda quiet: fuse_depth(quiet, views, head.mesh_world, labels, handed_over.pop())) as fused,
        run.stage("fine") as stage,
    ):
        refined = stage.keep(refine_head(stage.context, views, faces, head, labels, depth))
    votes, axes, depth = depth.votes, head.fit.world_from_head.rotation, None
    with run.beside("bust", lambda quiet: shape_bust(quiet, views, votes, refined, fused.product)) as surface:
        with run.stage("texture") as stage:
            texturing = stage.keep(texture_head(stage.context, views, head, refined, labels))
        with run.stage("evidence") as stage:
            pose = stage.keep(check_pose(stage.context, faces, alignment, head, refined))
            evidence = stage.keep(
                judge_head(stage.context, views, faces, alignment, head, refined, texturing=texturing, pose=pose)
            )
    with run.stage("bust") as stage:
        bust = stage.keep(colour_bust(stage.context, views, labels, surface.product, texturing.capture, axes))
        hair = stage.keep(push_out_hair(stage.context, views, refined, bust, texturing.capture))
    if any(warning.code == "pose-doubtful" for warning in run.warnings):  # of a refusal that was overruled, too
        pose = replace(pose, doubtful=True)
    refuse(run.warnings, context.settings.fail_on)
    context.progress("done", 1.0)
    result = Reconstruction(
        model_name=context.model.name,
        model_sha256=context.model.sha256,
        settings=context.settings,
        device=context.device.description if context.device else "cpu",
        digests=context.capture.digests,
        views=views,
        faces=faces,
        alignment=alignment,
        labels=labels,
        head=head,
        refined=refined,
        texturing=texturing,
        bust=bust,
        hair=hair,
        pose=pose,
        evidence=evidence,
        warnings=run.warnings,
        seconds=run.seconds(),
    )
    yield result.widen_by_scale(context.rig.scale_sigma) if context.rig.scale_sigma else result
