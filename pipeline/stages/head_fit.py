"""Fits the head to the outlines (the paper's section 4.4) by the solver in the settings, and then to the photographs.

The fit has two stages, ``fit_outlines`` and ``fit_head``, because the pixels are labelled between them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pipeline.contour_fit.bare_outline import (
    CapOutline,
    cells_of_views,
    fit_bare_outline,
    refit_with_crown,
    shrink_cap_outlines,
)
from pipeline.contour_fit.contour import ContourSolution, add_span_misfit, finish, last_problem, solve_contour
from pipeline.contour_fit.expression_evidence import doubtful_weights, solve_expressions
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import RELIEF_OF_OUTLINES, estimate_prior
from pipeline.head_model.gaussian_process import basis_of, model_basis
from pipeline.head_model.model import HeadModel
from pipeline.imaging.highlights import darken_highlights
from pipeline.part_labels.cap import Cap
from pipeline.photometric_fit.patches import HairProbability
from pipeline.photometric_fit.refine import FINE_AMPLITUDE_MM, refine_with_photographs
from pipeline.settings import PHOTO_LEVELS
from pipeline.simplex.hierarchy import fit_simplex
from pipeline.stages.alignment import Alignment
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.views import Views
from pipeline.warnings import Detail
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose

Cranium = Literal["hair", "cap", "bald"]
MAX_COST_RISE = 1.1  # of a fit without its doubtful expressions: those that explain noise leave 0.84 of the cost


@dataclass(frozen=True, slots=True, eq=False)
class OutlineFit:
    """Holds a head fitted only to the outlines. ``solution`` is the fit of the simplex method, or the state from which
    the contour solver continues."""

    solution: ContourSolution | Fit
    model: HeadModel  # with the modes that the solution has
    mesh_world: Mesh


@dataclass(frozen=True, slots=True, eq=False)
class HeadFit:
    """Holds a fit with its covariance, the model whose modes it uses, and the level of detail that it reached.

    ``cranium`` states what forms the cranium's outline: hair, a cap of known thickness, or skin; None if unknown.
    """

    fit: Fit
    model: HeadModel
    detail: Detail
    cranium: Cranium | None = None
    doubtful: frozenset[int] = frozenset()  # expressions, by their place among the model's, that the fit left out
    solution: ContourSolution | None = None  # what ``fit`` was made of, for other captures of the same person

    @property
    def mesh_world(self) -> Mesh:
        """Returns the fitted head as a full-resolution mesh, world frame, mm."""
        return fitted_mesh(self.model, self.fit)


def fitted_mesh(model: HeadModel, fit: Fit) -> Mesh:
    """Computes the full-resolution mesh of a fitted head, world frame, mm."""
    return Mesh(fit.world_from_head.apply(model.vertices(fit.coefficients)), model.levels["full"].faces)


def fit_outlines(
    context: ReconstructionContext, views: Views, alignment: Alignment, cap: Cap | None
) -> Staged[OutlineFit]:
    """Fits shape and pose to the silhouettes with the contour solver. If the settings choose the simplex method, the
    function then fits the shape again at this pose. Outlines along the ``cap`` are moved inwards by its thickness and
    then show the skull."""
    settings, rig = context.settings, context.rig
    bare = CapOutline(views.silhouettes, {})
    if cap is not None:
        bare = shrink_cap_outlines(views.silhouettes, cap, rig, alignment.world_from_head.translation)
    model, features = model_basis(context.model, settings), views.capture.features
    start, seen, fitting, report = alignment.world_from_head, bare.silhouettes, settings.fitting, context.progress
    solved = solve_contour(
        model, start, seen, rig, fitting, features=features, landmarks=alignment.landmarks, report=report
    )
    if settings.method == "simplex":
        # The simplex never moves the pose, and what seven points leave (3 degrees, 5 mm) would all become shape.
        pose = solved.state.world_from_head
        fit = fit_simplex(model, pose, seen, rig, fitting, renderer=context.renderer, report=report)
        return Staged(OutlineFit(fit, model, fitted_mesh(model, fit)))
    if cap is not None:
        solved = refit_with_crown(solved, cells_of_views(bare.cells, solved.problem.views))
    state, model = solved.state, solved.problem.model
    vertices_world = state.world_from_head.apply(model.vertices(state.coefficients))
    return Staged(OutlineFit(solved, model, Mesh(vertices_world, model.levels["full"].faces)))


def refine_with_likely_face(
    outlines: ContourSolution, images: Mapping[str, ImageRgb], hair: HairProbability
) -> tuple[ContourSolution, Detail, frozenset[int]]:
    """Refines the fit with the photographs. If the expression contradicts itself, the fit is repeated without doubtful
    expressions, and kept if it explains the photographs equally well. Returns the doubtful expressions too."""
    solved, detail = refine_with_photographs(outlines, images, hair=hair)
    doubtful = doubtful_weights(solved.problem.model, solved.state.coefficients)
    if not doubtful:
        return solved, detail, doubtful
    plain = replace(outlines, problem=replace(outlines.problem, held=doubtful))
    again, detail_again = refine_with_photographs(plain, images, hair=hair)
    if last_problem(again)[1].cost > MAX_COST_RISE * last_problem(solved)[1].cost:
        return solved, detail, doubtful
    return again, detail_again, doubtful


def fit_head(context: ReconstructionContext, views: Views, outlines: OutlineFit, labels: PartLabels) -> Staged[HeadFit]:
    """Refines the fit with the photographs' pixels inside the outlines. Settings and photographs limit the level of
    detail."""
    settings, model, solved = context.settings, outlines.model, outlines.solution
    if isinstance(solved, Fit):
        return Staged(HeadFit(solved, model, Detail("span", compose("level-simplex"))))
    cranium: Cranium | None = None if labels.cap is None else "cap"
    doubtful = frozenset[int]()
    detail = Detail("span" if settings.detail == "span" else "kernel", compose("level-asked"))
    if settings.detail in PHOTO_LEVELS:
        hair = labels.hiding_probability()
        if labels.cap is None:
            solved = fit_bare_outline(solved, labels.skin_probability())
            cranium = "hair" if solved.evidence.noise.bare is None else "bald"
        images = darken_highlights(views.capture.images, views.silhouettes, context.rig, outlines.mesh_world)
        solved, detail, doubtful = refine_with_likely_face(solved, images, hair)
    eigenheads, model = min(settings.fitting.modes, len(model.modes)), solved.problem.model
    relief_mm = FINE_AMPLITUDE_MM * (RELIEF_OF_OUTLINES if detail.level == "kernel" else 1.0)
    unlike = detail.reason.code == "level-alike-too-little"  # of 150 captures three, all turned by 3 to 13 degrees
    doubts = [compose("pose-doubtful", finding=compose("pose-unlike"))] if unlike else []
    if detail.level == "photo":
        solved = solve_expressions(solved, eigenheads)
    if detail.level == "span":
        wider = basis_of(model, eigenheads, kernel=True)
        fit = add_span_misfit(solved, wider, relief_mm=relief_mm)
        return Staged(HeadFit(fit, model, detail, cranium, doubtful, solved))
    fit = estimate_prior(model, finish(solved), eigenheads, relief_mm=relief_mm)
    return Staged(HeadFit(fit, model, detail, cranium, doubtful, solved), doubts)
