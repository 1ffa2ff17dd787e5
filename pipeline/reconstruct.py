"""Capture to textured head (section 4): the composition that the worker, the command line and the tests all call."""

import time
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from pipeline.clock import Clock, Report, of_stage
from pipeline.dense.depth_map import DepthMap
from pipeline.dense.estimate import estimate_depth
from pipeline.dense.part_votes import PartVotes, vote_parts
from pipeline.dense.parts import HAIR
from pipeline.dense.surface.signed_distance import NoSurface
from pipeline.dense.surface.skin import part_of
from pipeline.dense.window_bias import WindowBias
from pipeline.diagnostics import Detail, ReportWarning
from pipeline.eigenheads.model import HeadModel
from pipeline.evidence.camera_metrics import camera_figures, start_masks
from pipeline.evidence.expression import LEAST_SIGMA, READ_SIGMA, found_expressions, posable_head, shut_eyes
from pipeline.evidence.measurements import landmarks, measurements
from pipeline.evidence.plausibility import plausibility_warnings, refuse
from pipeline.first_fit import align, basis, fit_head, fitted_mesh, front_camera
from pipeline.fitting.expression_evidence import makes_face
from pipeline.fitting.fine.blink import blinks_of, with_lids
from pipeline.fitting.fine.dense_points import dense_points
from pipeline.fitting.fine.depth_bias import measure_bias, points_on_face, without_window_bias
from pipeline.fitting.fine.expression_reading import with_read_expression
from pipeline.fitting.fine.eyelids import look_at_eyes
from pipeline.fitting.fine.patch_points import PatchSearch, patch_search
from pipeline.fitting.fine.refine import Displaced, refine_to_surface
from pipeline.fitting.fine.surface_points import SurfacePoints
from pipeline.fitting.fit import Fit
from pipeline.fitting.posterior import vertex_deviation_mm
from pipeline.imaging.cpu_raster import depth_maps
from pipeline.imaging.silhouette import Silhouette
from pipeline.results.bust import Bust, make_bust
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import FINE_LEVELS, Settings
from pipeline.silhouettes.segment import segment
from pipeline.silhouettes.usable_views import usable_views
from pipeline.texture.chart_colours import chart_colours, with_true_colours
from pipeline.texture.delight import DIM_SHARE, delight
from pipeline.texture.head_texture import find_layout, paint_head
from pipeline.texture.reduced_layout import reduced_layout
from pipeline.texture.vertex_colours import texture
from rig.capture import Capture
from rig.formats.usdz import check_usd
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig

Segment = Callable[..., dict[str, Silhouette]]


def reconstruct(
    capture: Capture,
    rig: Rig,
    model: HeadModel,
    settings: Settings,
    *,
    renderer: Renderer,
    report: Report,
    segment: Segment = segment,
) -> Reconstruction:
    """Capture to textured head (section 4). Reads and writes no files. A caller that keeps silhouettes gives a
    ``segment`` of its own.

    Raises EigenheadError where there is no answer (too few usable views, feature points that determine nothing) or a
    warning is one that the settings do not let pass, and Cancelled when ``report`` does.
    """
    if "usdz" in settings.outputs.written:
        check_usd()
    started = time.perf_counter()
    clock = Clock(report)
    clock("segmentation")

    def segmented(shot: Capture) -> dict[str, Silhouette]:
        return segment(shot, rig, settings.segmentation, report=report)

    found = usable_views(capture, rig, segmented, exchanged=settings.exchanged_pictures)
    digests, capture, silhouettes = capture.digests, found.capture, found.silhouettes
    clock("alignment")
    population, model = model, basis(model, settings)
    front = front_camera(rig, settings)
    start, warnings = align(model, capture, silhouettes, rig, settings, front, report)
    clock("fit")
    fit, model, detail, parts = fit_head(model, start, capture, silhouettes, rig, settings, renderer, clock)
    full, finer = model.levels["full"], None
    mesh, quality = fitted_mesh(model, fit), vertex_deviation_mm(model, fit)
    fine = detail.level == "photo" and settings.detail in FINE_LEVELS
    maps: tuple[DepthMap, ...] = ()
    if fine or settings.outputs.surface != "head":
        clock("depth")
        told_depth = partial(of_stage, clock.report, "depth")
        maps = estimate_depth(capture.images, silhouettes, rig, mesh, settings.dense, report=told_depth)
    votes = vote_parts(maps, parts, rig)
    surface = dense_points(maps, votes, mesh, settings.fine)
    on_face = points_on_face(surface, mesh, full.face_region)
    bias = measure_bias(on_face)
    if fine:
        clock("fine")
        surface = without_window_bias(surface, on_face, bias)
        distances = {name: silhouettes[name].distance for name, used in fit.used.items() if used}
        hair = {name: part.probability[..., HAIR] for name, part in parts.items()}
        patches = patch_search(model, fit, capture.images, distances, hair, rig, settings.photo)
        finer, detail = fine_head(model, fit, quality, surface, patches, capture, rig, settings, report)
        if finer is not None:
            mesh, quality = Mesh(finer.vertices, full.faces), finer.deviation_mm
    clock("texture")
    normals, depths = mesh.normals(), depth_maps(rig, mesh)
    layout, texture_warnings = find_layout(model, settings)
    around = None if layout is None else layout.around
    dim_share = DIM_SHARE if settings.outputs.delit else None
    chart, chart_warnings = chart_colours(capture, rig) if settings.texture.chart else (None, [])
    shown = capture if chart is None else with_true_colours(capture, chart)
    given = (mesh, normals, shown, silhouettes, rig, depths, settings.texture)
    coloured = texture(*given, around=around, dim_share=dim_share)
    atlas = paint_head(layout, mesh, coloured, full.face_region, settings)
    lit = (mesh, normals, coloured, atlas, full.face_region, around, chart)
    light = reduced_layout(model, layout.layout) if layout is not None and settings.outputs.normal_map else None
    albedo, albedo_warnings = delight(*lit) if settings.outputs.delit else (None, [])
    bust, bust_warnings = None, []
    if settings.outputs.surface != "head":
        skin = None if finer is None else part_of(mesh, finer.observed)
        bust, bust_warnings = find_bust(maps, votes, bias, shown, silhouettes, rig, mesh, skin, settings, clock)
    clock("evidence")
    before = start_masks(model, start, rig)
    fitted_masks = {name: np.isfinite(depth) for name, depth in depths.items()}
    figures = camera_figures(model, fit, silhouettes, rig, fitted_masks, before)
    widths = {camera.name: camera.intrinsics.width for camera in rig}
    implausible = plausibility_warnings(fit, model, figures, widths)
    made, least_sigma = fit, LEAST_SIGMA
    if finer is not None:
        made, least_sigma = face_made(fit, model, population, finer, settings)
    closed = shut_eyes(model, made) | (frozenset() if finer is None else finer.closed_eyes)
    expression = found_expressions(model, made, least_sigma)
    asked = settings.outputs.neutral or settings.outputs.morphs
    posable = posable_head(model, fit.world_from_head, mesh, expression) if asked else None
    told = (
        *found.warnings,
        *implausible,
        *warnings,
        *eye_warnings(closed),
        *chart_warnings,
        *coloured.warnings,
        *texture_warnings,
        *albedo_warnings,
        *bust_warnings,
    )
    refuse(told, settings.fail_on)
    clock("")
    report("done", 1.0)
    return Reconstruction(
        fit=fit,
        model_name=model.name,
        model_sha256=model.sha256,
        mesh_world=mesh,
        normals=normals,
        colours=coloured.colours,
        views=coloured.views,
        quality_mm=quality,
        silhouettes=silhouettes,
        start_masks=before,
        fitted_masks=fitted_masks,
        cameras=figures,
        landmarks=landmarks(model, fit, mesh.vertices),
        measurements=measurements(model, fit, mesh.vertices),
        front=front,
        settings=settings,
        digests=digests,
        pictures=found.pictures,
        seconds=clock.seconds | {"total": time.perf_counter() - started},
        warnings=told,
        gains=coloured.gains,
        chart=chart,
        detail=detail,
        atlas=atlas,
        reduced=light,
        expression=expression,
        posed=model.posed,
        posable=posable,
        albedo=albedo,
        bust=bust,
        parts=parts,
    )


def find_bust(
    maps: tuple[DepthMap, ...],
    votes: PartVotes | None,
    bias: WindowBias,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    head_world: Mesh,
    head_skin_world: Mesh | None,
    settings: Settings,
    clock: Clock,
) -> tuple[Bust | None, list[ReportWarning]]:
    """All that the cameras see, as one closed surface; a warning where the photographs do not tell it."""
    clock("bust")
    try:
        given = (maps, capture, silhouettes, rig, head_world, votes, bias, settings)
        bust = make_bust(*given, head_skin_world=head_skin_world, report=clock.report)
    except NoSurface as reason:
        return None, [ReportWarning("no-bust", str(reason))]
    return bust, list(bust.surface.warnings)


def fine_head(
    model: HeadModel,
    fit: Fit,
    deviation_mm: np.ndarray,
    surface: SurfacePoints,
    patches: PatchSearch,
    capture: Capture,
    rig: Rig,
    settings: Settings,
    report: Report,
) -> tuple[Displaced | None, Detail]:
    """The fit's head drawn to what the dense stage knows, and why no deeper where that is too little."""
    mesh = fitted_mesh(model, fit)
    eyes = look_at_eyes(model, mesh.vertices, capture.images, rig)
    eigenheads = min(settings.fitting.modes, len(fit.coefficients))
    head = refine_to_surface(
        fit,
        model,
        surface,
        settings.fine,
        eigenheads=eigenheads,
        deviation_mm=deviation_mm,
        eyes=eyes,
        patches=patches,
        report=report,
    )
    share = float(head.observed[model.levels["full"].face_region].mean())
    if share < settings.fine.least_share:
        why = f"the dense surface shows only {share:.0%} of the face, {settings.fine.least_share:.0%} are needed"
        return None, Detail("photo", why)
    return head, Detail("fine", f"the dense surface shows {share:.0%} of the face")


def face_made(
    fit: Fit, model: HeadModel, population: HeadModel, finer: Displaced, settings: Settings
) -> tuple[Fit, float]:
    """The fit with the expression that the finished head makes: what its surface tells where the fit found a face that
    is made at all, and how far its lids are closed where the points about the eye tell. And of how many deviations a
    weight must be."""
    places = blinks_of(model)
    lids = {side: share for side, share in finer.lids.items() if share != float(fit.coefficients[places[side]])}
    if not makes_face(fit.coefficients, model.posed):
        return with_lids(fit, model, lids), LEAST_SIGMA
    eigenheads, median = min(settings.fitting.modes, len(population.modes)), settings.fitting.expression_median
    given = (fit, model, population, finer.vertices, finer.observed)
    read = with_read_expression(*given, eigenheads=eigenheads, median=median)
    return with_lids(read, model, lids), LEAST_SIGMA if read is fit else READ_SIGMA


def eye_warnings(closed: frozenset[str]) -> list[ReportWarning]:
    """Closed eyes are no fault, but most studios want another shot."""
    if not closed:
        return []
    which = "both eyes are" if len(closed) == 2 else f"the {min(closed)} eye is"
    return [ReportWarning("eyes-closed", f"{which} closed: no white and no iris in the photographs, or lids that meet")]
