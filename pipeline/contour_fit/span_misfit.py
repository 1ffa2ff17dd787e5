"""What a fit to the eigenheads leaves out: most heads are none of the span, and its own covariance does not say so.

Between outlines the error of such a fit is several times what it leaves at them, where it was made to agree. So the
same outlines are asked once more in a basis that need not contain the head in a population (``gaussian_process``): how
far the two heads are apart, and what the wider one leaves open, is what the narrower one may be off by.
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
    """Returns the fit of a solution, with a misfit that covers what the eigenheads cannot represent.

    Args:
        solved: to the outlines, with the eigenheads alone.
        wider_model: the same mesh and eigenheads, followed by the kernel's modes.
        relief_mm: of ``with_estimated_prior``.
    """
    fit, eigenheads = finish(solved), len(solved.state.coefficients)
    problem = widened(solved.problem, wider_model, (LEVEL,))
    last = solved.problem.settings.robust_px
    stage = Stage(LEVEL, len(wider_model.modes), True, (2.0 * last, last), solved.stage.whole_head, True, STEPS)
    state, evaluations, reason = run_stage(problem, solved.evidence, solved.state, stage, lambda fraction: None)
    wider = finish(ContourSolution(problem, solved.evidence, state, stage, evaluations, reason))
    return judged_by(
        wider_model,
        with_estimated_prior(wider_model, wider, eigenheads, relief_mm=relief_mm),
        solved.problem.model,
        fit,
    )


def judged_by(wider_model: HeadModel, wider: Fit, model: HeadModel, fit: Fit) -> Fit:
    """Returns ``fit`` with its misfit (mm, along the normals) set from ``wider``, a fit of more modes to the same
    outlines: from their distance and the variance that only the wider one has. Both need a covariance."""
    cage = fit.world_from_head.apply(model.cage(fit.coefficients))
    normals = vertex_normals(cage, model.levels["cage"].faces)
    apart = ((wider.world_from_head.apply(wider_model.cage(wider.coefficients)) - cage) * normals).sum(axis=1)
    square = apart**2 + cage_variance(wider_model, wider) - cage_variance(model, fit)
    return replace(fit, misfit_mm=np.sqrt(np.maximum(square, 0.0)), sliding_mm=wider.sliding_mm)
