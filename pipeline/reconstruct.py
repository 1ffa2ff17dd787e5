"""Capture to textured head (section 4): the composition that the worker, the command line and the tests all call."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from pipeline.alignment.landmarks import feature_alignment
from pipeline.alignment.silhouette_search import search_alignment
from pipeline.dense.depth_map import DepthMap
from pipeline.dense.estimate import estimate_depth
from pipeline.dense.part_votes import PartVotes, vote_parts
from pipeline.dense.parts import HAIR, PartMap, classify_parts
from pipeline.dense.surface.signed_distance import NoSurface
from pipeline.dense.surface.skin import part_of
from pipeline.dense.window_bias import WindowBias
from pipeline.diagnostics import Detail, ReportWarning
from pipeline.eigenheads.gaussian_process import with_kernel
from pipeline.eigenheads.model import HeadModel, with_expressions, with_modes
from pipeline.fitting.contour import finish, solve_contour
from pipeline.fitting.expression_evidence import with_expression_evidence
from pipeline.fitting.fine.blink import with_lids
from pipeline.fitting.fine.dense_points import dense_points
from pipeline.fitting.fine.depth_bias import measure_bias, points_on_face, without_window_bias
from pipeline.fitting.fine.eyelids import look_at_eyes
from pipeline.fitting.fine.patch_points import PatchSearch, patch_search
from pipeline.fitting.fine.refine import Displaced, refine_to_surface
from pipeline.fitting.fine.surface_points import SurfacePoints
from pipeline.fitting.fit import Fit
from pipeline.fitting.photo.refine import refine_with_photographs
from pipeline.fitting.posterior import RELIEF_OF_OUTLINES, vertex_deviation_mm, with_estimated_prior
from pipeline.fitting.simplex.hierarchy import fit_simplex
from pipeline.fitting.span_misfit import with_span_misfit
from pipeline.imaging.cpu_raster import depth_maps
from pipeline.imaging.silhouette import Silhouette
from pipeline.kept_arrays import kept_arrays
from pipeline.results.bust import Bust, make_bust
from pipeline.results.camera_metrics import camera_figures, start_masks
from pipeline.results.expression import found_expressions, posable_head, shut_eyes
from pipeline.results.measurements import landmarks, measurements
from pipeline.results.plausibility import plausibility_warnings, refuse
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import FINE_LEVELS, PHOTO_LEVELS, Settings
from pipeline.silhouettes.segment import segment
from pipeline.silhouettes.usable_views import usable_views
from pipeline.texture.delight import DIM_SHARE, delight
from pipeline.texture.head_texture import find_layout, paint_head
from pipeline.texture.vertex_colours import texture
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.formats.usdz import check_usd
from rig.geometry import Similarity
from rig.mesh import Mesh, vertex_normals
from rig.render.renderer import Renderer
from rig.rig import Rig

Report = Callable[[str, float], None]
Segment = Callable[..., dict[str, Silhouette]]


@dataclass
class Clock:
    """Seconds by stage, and the one place that reports it."""

    report: Report
    seconds: dict[str, float] = field(default_factory=dict)
    _stage: str = ""
    _since: float = field(default_factory=time.perf_counter)

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        if self._stage:
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        if stage:
            self.report(stage, 0.0)


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
    model = basis(model, settings)
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
        told_depth = partial(_of_stage, clock.report, "depth")
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
    given = (mesh, normals, capture, silhouettes, rig, depths, settings.texture)
    coloured = texture(*given, around=around, dim_share=dim_share)
    atlas = paint_head(layout, mesh, coloured, full.face_region, settings)
    lit = (mesh, normals, coloured, atlas, full.face_region, around)
    albedo, albedo_warnings = delight(*lit) if settings.outputs.delit else (None, [])
    bust, bust_warnings = None, []
    if settings.outputs.surface != "head":
        skin = None if finer is None else part_of(mesh, finer.observed)
        bust, bust_warnings = find_bust(maps, votes, bias, capture, silhouettes, rig, mesh, skin, settings, clock)
    clock("evidence")
    before = start_masks(model, start, rig)
    fitted_masks = {name: np.isfinite(depth) for name, depth in depths.items()}
    figures = camera_figures(model, fit, silhouettes, rig, fitted_masks, before)
    widths = {camera.name: camera.intrinsics.width for camera in rig}
    implausible = plausibility_warnings(fit, figures, widths, model.posed)
    made = fit if finer is None else with_lids(fit, model, finer.lids)
    closed = shut_eyes(model, made) | (frozenset() if finer is None else finer.closed_eyes)
    expression = found_expressions(model, made)
    asked = settings.outputs.neutral or settings.outputs.morphs
    posable = posable_head(model, fit.world_from_head, mesh, expression) if asked else None
    told = (
        *found.warnings,
        *implausible,
        *warnings,
        *eye_warnings(closed),
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
        detail=detail,
        atlas=atlas,
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


def _of_stage(report: Report, stage: str, _: str, fraction: float) -> None:
    report(stage, fraction)


def basis(model: HeadModel, settings: Settings) -> HeadModel:
    """The modes that the settings ask for: the eigenheads in use; where the detail goes beyond, the kernel's and the
    model's expressions, too."""
    span = settings.detail == "span" or settings.method == "simplex"
    return _basis(model, min(settings.fitting.modes, len(model.modes)), kernel=not span)


@lru_cache(maxsize=2)  # models are few, jobs are many, and others keep what they make of the same model
def _basis(model: HeadModel, modes: int, *, kernel: bool) -> HeadModel:
    if not kernel:
        return with_modes(model, modes)
    given = (model.mean, model.modes[:modes], model.sigma[:modes], model.levels["cage"].faces)

    def make() -> dict[str, np.ndarray]:
        wider = with_kernel(model, modes)
        return {"modes": wider.modes, "sigma": wider.sigma}

    kept = kept_arrays("kernel-modes", given, make, made_by=(with_kernel, vertex_normals, HeadModel))
    wide = replace(with_modes(model, modes), modes=kept["modes"], sigma=kept["sigma"], _bases={})
    return with_expressions(wide)


def front_camera(rig: Rig, settings: Settings) -> str:
    """The camera that the subject faces: the stated one, or the middle of the fan."""
    if settings.front is None:
        return rig.front_camera()
    if settings.front not in rig:
        raise EigenheadError(f"front camera {settings.front!r} is not in the rig; it has {', '.join(rig.names)}")
    return settings.front


def align(
    model: HeadModel,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    front: str,
    report: Report,
) -> tuple[Similarity, list[ReportWarning]]:
    """world_from_head of the mean head: from feature points (section 4.2), or found from the silhouettes."""
    if not capture.features:
        return search_alignment(model, silhouettes, rig, settings, front=front, report=report), []
    found = feature_alignment(model, capture.features, rig, settings.alignment)
    return found.world_from_head, [ReportWarning("features", remark) for remark in found.remarks]


def fit_head(
    model: HeadModel,
    start: Similarity,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    renderer: Renderer,
    clock: Clock,
) -> tuple[Fit, HeadModel, Detail, Mapping[str, PartMap]]:
    """Section 4.4 by the solver that the settings name: the fit, the model with the modes that it has, how deep it
    went, and what the pixels show (nothing where nobody asks for it)."""
    report = clock.report
    if settings.method == "simplex":
        # The simplex never moves the pose, and what seven points leave (3 degrees, 5 mm) would all become shape.
        posed = solve_contour(model, start, silhouettes, rig, settings.fitting, features=capture.features)
        place = posed.state.world_from_head
        fit = fit_simplex(model, place, silhouettes, rig, settings.fitting, renderer=renderer, report=report)
        parts = find_parts(model, fitted_mesh(model, fit), capture, silhouettes, rig, settings, clock)
        return fit, model, Detail("span", "the simplex searches the eigenheads alone"), parts
    solved = solve_contour(model, start, silhouettes, rig, settings.fitting, features=capture.features, report=report)
    detail = Detail("span" if settings.detail == "span" else "kernel", "the settings ask for it")
    state, own = solved.state, solved.problem.model
    head_world = Mesh(state.world_from_head.apply(own.vertices(state.coefficients)), own.levels["full"].faces)
    parts = find_parts(own, head_world, capture, silhouettes, rig, settings, clock)
    if settings.detail in PHOTO_LEVELS:
        hair = {name: part.probability[..., HAIR] for name, part in parts.items()}
        solved, detail = refine_with_photographs(solved, capture.images, settings.photo, hair=hair)
    model, eigenheads = solved.problem.model, min(settings.fitting.modes, len(model.modes))
    if detail.level == "photo":
        solved = with_expression_evidence(solved, eigenheads)
    relief_mm = settings.photo.fine_amplitude_mm
    if detail.level == "span":
        wider = _basis(model, eigenheads, kernel=True)
        return with_span_misfit(solved, wider, relief_mm=relief_mm), model, detail, parts
    if detail.level == "kernel":
        relief_mm *= RELIEF_OF_OUTLINES
    return with_estimated_prior(model, finish(solved), eigenheads, relief_mm=relief_mm), model, detail, parts


def find_parts(
    model: HeadModel,
    head_world: Mesh,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: Settings,
    clock: Clock,
) -> dict[str, PartMap]:
    """Skin, hair and clothes in every photograph, where the settings ask for what depends on it."""
    if settings.detail not in PHOTO_LEVELS and settings.outputs.surface == "head":
        return {}
    clock("parts")
    places = {name: head_world.vertices[vertex] for name, vertex in model.landmarks.items()}
    region = model.levels["full"].face_region
    given = (capture.images, silhouettes, rig, head_world, region, places, settings.parts)
    found = classify_parts(*given, report=partial(_of_stage, clock.report, "parts"))
    clock("fit")
    return found


def fitted_mesh(model: HeadModel, fit: Fit) -> Mesh:
    """The fit's head, full level, world frame."""
    return Mesh(fit.world_from_head.apply(model.vertices(fit.coefficients)), model.levels["full"].faces)


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


def eye_warnings(closed: frozenset[str]) -> list[ReportWarning]:
    """Closed eyes are no fault, but most studios want another shot."""
    if not closed:
        return []
    which = "both eyes are" if len(closed) == 2 else f"the {min(closed)} eye is"
    return [ReportWarning("eyes-closed", f"{which} closed: no white and no iris in the photographs, or lids that meet")]
