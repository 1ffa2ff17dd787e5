"""From silhouettes to a fitted head: where it is, and section 4.4 by the solver that the settings name.

Enters: a capture with its silhouettes. Leaves: a ``Fit``, the model with the modes that it has, how deep it went, and
what the pixels show.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from pipeline.alignment.landmarks import feature_alignment
from pipeline.alignment.silhouette_search import search_alignment
from pipeline.clock import Clock, Report, of_stage
from pipeline.dense.parts import HAIR, PartMap, classify_parts
from pipeline.diagnostics import Detail, ReportWarning
from pipeline.eigenheads.gaussian_process import with_kernel
from pipeline.eigenheads.model import HeadModel, with_expressions, with_modes
from pipeline.fitting.contour import finish, solve_contour
from pipeline.fitting.expression_evidence import with_expression_evidence
from pipeline.fitting.fit import Fit
from pipeline.fitting.photo.refine import refine_with_photographs
from pipeline.fitting.posterior import RELIEF_OF_OUTLINES, with_estimated_prior
from pipeline.fitting.simplex.hierarchy import fit_simplex
from pipeline.fitting.span_misfit import with_span_misfit
from pipeline.imaging.silhouette import Silhouette
from pipeline.kept_arrays import kept_arrays
from pipeline.settings import PHOTO_LEVELS, Settings
from rig.capture import Capture
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.mesh import Mesh, vertex_normals
from rig.render.renderer import Renderer
from rig.rig import Rig


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
    found = classify_parts(*given, report=partial(of_stage, clock.report, "parts"))
    clock("fit")
    return found


def fitted_mesh(model: HeadModel, fit: Fit) -> Mesh:
    """The fit's head, full level, world frame."""
    return Mesh(fit.world_from_head.apply(model.vertices(fit.coefficients)), model.levels["full"].faces)
