"""Estimates how far a fit to the eigenheads alone may be off because the head is not in their span. Most heads are not,
and the fit's own covariance does not include that.

The fit agrees with the outlines, where it was made to; between them its error is several times larger. So the same
outlines are fitted once more in a wider basis that can leave the span (``gaussian_process``). The distance between both
heads, and the wider fit's own uncertainty, are the misfit of the narrower one.
"""

from dataclasses import replace

import numpy as np

from pipeline.contour_fit.contour import ContourSolution, finish, run_stage
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import cage_variance, with_estimated_prior
from pipeline.contour_fit.problem import Stage, widened
from pipeline.head_model.model import HeadModel
from rig.mesh import vertex_normals

LEVEL, STEPS = "p95", 4  # as the contour solver's own stage with more modes


def with_span_misfit(solved: ContourSolution, wider_model: HeadModel, *, relief_mm: float) -> Fit:
    """Returns the fit of a solution with its misfit set to what the eigenheads cannot represent.

    Args:
        solved: solution with the eigenheads alone.
        wider_model: the same mesh and eigenheads, followed by the kernel's modes.
        relief_mm: as of ``with_estimated_prior``.
    """
    fit, eigenheads = finish(solved), len(solved.state.coefficients)
    problem = widened(solved.problem, wider_model, (LEVEL,))
    last = solved.problem.settings.robust_px
    stage = Stage(LEVEL, len(wider_model.modes), True, (2.0 * last, last), solved.stage.whole_head, True, STEPS)
    state, evaluations, reason = run_stage(problem, solved.evidence, solved.state, stage, lambda fraction: None)
    wider = finish(ContourSolution(problem, solved.evidence, state, stage, evaluations, reason))
    wider = with_estimated_prior(wider_model, wider, eigenheads, relief_mm=relief_mm)
    return judged_by(wider_model, wider, solved.problem.model, fit)


def judged_by(wider_model: HeadModel, wider: Fit, model: HeadModel, fit: Fit) -> Fit:
    """Returns ``fit`` with its misfit (mm, along the normals) set by comparison with ``wider``, a fit of more modes to
    the same outlines. The misfit's square is their squared distance plus the variance that only the wider fit has. Both
    fits must have a covariance."""
    cage = fit.world_from_head.apply(model.cage(fit.coefficients))
    normals = vertex_normals(cage, model.levels["cage"].faces)
    apart = ((wider.world_from_head.apply(wider_model.cage(wider.coefficients)) - cage) * normals).sum(axis=1)
    square = apart**2 + cage_variance(wider_model, wider) - cage_variance(model, fit)
    return replace(fit, misfit_mm=np.sqrt(np.maximum(square, 0.0)), sliding_mm=wider.sliding_mm)
