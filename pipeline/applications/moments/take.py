"""Reconstructs a take (several captures of one person) with one common identity.

Each capture runs the stages of a single job up to the fit to photographs. A joint fit then estimates the common
identity (``joint_fit``); afterwards each capture continues to its fine surface, colours and evidence. The heads of all
captures have corresponding vertices; the person's neutral head and blendshapes are computed from them (``own_shapes``).
"""

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.applications.moments.joint_fit import fit_jointly, joint_covariances
from pipeline.applications.moments.own_shapes import OwnShapes, estimate_own_shapes
from pipeline.contour_fit.contour import ContourSolution
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import RELIEF_OF_OUTLINES, estimate_prior
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.refine import FINE_AMPLITUDE_MM
from pipeline.reconstruct import start_reconstruction
from pipeline.results.head_files import head_from_world
from pipeline.results.reconstruction import Reconstruction
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.head_fit import HeadFit
from pipeline.warnings import ReportWarning
from rig.errors import Cancelled, EigenheadError, InputError
from rig.geometry import Similarity
from rig.messages.message import Message, compose
from rig.progress import Progress, discard_progress

MIN_MOMENTS = 2
OTHER_PERSON = 3.0  # RMS difference of the eigenheads (standard deviations) beyond which the person is another
OBSERVED = ("segmentation", "faces", "alignment", "fit", "parts")
DELIVERED = ("depth", "fine", "texture", "evidence", "bust")
JOINT = "identity"  # the stage that solves for it
SHARES = (0.45, 0.55)  # of a take's time, at which the joint fit begins and ends


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Holds the result of one capture of a take. Arrays are indexed by expression or by vertex of the finest mesh."""

    name: str
    detail: str  # the level of detail
    weights: Float[np.ndarray, " e"]
    weight_deviation: Float[np.ndarray, " e"]
    world_from_head: Similarity
    head: Float[np.ndarray, "v 3"]  # head frame, mm
    deviation_mm: Float[np.ndarray, " v"]
    apart: float  # RMS difference of its separate identity from the joint one, in standard deviations
    warnings: tuple[ReportWarning, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """Holds the result of a take: the person's neutral head and blendshapes, and each capture's result."""

    model: HeadModel
    person: OwnShapes
    moments: tuple[Moment, ...]
    warnings: tuple[Message, ...]


def check_count(count: int) -> None:
    """Raises InputError if there are fewer captures than a take needs."""
    if count < MIN_MOMENTS:
        raise InputError("take", [compose("take-too-small", count=count)])


def reconstruct_take(
    contexts: Mapping[str, ReconstructionContext],
    deliver: Callable[[str, Reconstruction], None] = lambda name, result: None,
    *,
    report: Progress = discard_progress,
) -> Take:
    """Reconstructs the captures of one person; ``contexts`` is indexed by the captures' names.

    Args:
        contexts: one for each capture, all with the same model and settings.
        deliver: receives each capture's finished result, which is then discarded.
        report: receives the overall progress; raises Cancelled to stop. The contexts' hooks are not called.

    Raises InputError for fewer than two captures or the method ``simplex``, and the errors of ``reconstruct`` with the
    capture's name."""
    check_count(len(contexts))
    progress, fitted = _Advance(report, len(contexts)), dict[str, tuple[Generator[Any, HeadFit, None], HeadFit]]()
    for k, (name, context) in enumerate(contexts.items()):
        with name_errors(name):
            steps = start_reconstruction(replace(context, progress=progress.of(name, k)))
            fitted[name] = steps, next(steps)
    alone = [solution_of(head) for _, head in fitted.values()]
    first = next(iter(contexts.values()))
    eigenheads = min(first.settings.fitting.modes, len(first.model.modes))
    joint = fit_jointly(alone, eigenheads, watch=lambda: report(JOINT, SHARES[0]))
    moments = []
    for solved, (name, covariance) in zip(joint, zip(contexts, joint_covariances(joint), strict=True), strict=True):
        steps, head = fitted.pop(name)
        apart = measure_difference(head.fit, solved, eigenheads)
        with name_errors(name):
            result = steps.send(joined(head, solved, covariance, eigenheads))
        moments.append(_moment(name, result, apart))
        deliver(name, result)
    warnings = [
        compose("take-other-person", moment=each.name, sigmas=each.apart)
        for each in moments
        if each.apart > OTHER_PERSON
    ]
    return Take(first.model, _own_shapes(first.model, joint, moments), tuple(moments), tuple(warnings))


def joined(head: HeadFit, solved: ContourSolution, covariance: Float[np.ndarray, "p p"], eigenheads: int) -> HeadFit:
    """Returns a capture's fitted head with the joint solution and its covariance."""
    state, level = solved.state, head.detail.level
    fit = replace(
        head.fit,
        coefficients=state.coefficients,
        world_from_head=state.world_from_head,
        evaluations=solved.evaluations,
        covariance=covariance,
        camera_shift=dict(zip(solved.problem.views.names, state.camera_shift, strict=True)),
    )
    if level != "span":
        relief_mm = FINE_AMPLITUDE_MM * (RELIEF_OF_OUTLINES if level == "kernel" else 1.0)
        fit = replace(fit, misfit_mm=solved.misfit_mm)
        fit = estimate_prior(head.model, fit, eigenheads, relief_mm=relief_mm)
    return replace(head, fit=fit, solution=None)


def measure_difference(alone: Fit, joint: ContourSolution, eigenheads: int) -> float:
    """Returns the difference between a capture's separately estimated identity and the joint identity: the RMS over the
    eigenheads, in standard deviations of the capture's separate posterior."""
    assert alone.covariance is not None
    apart = (alone.coefficients - joint.state.coefficients[: len(alone.coefficients)])[:eigenheads]
    return float(np.sqrt(apart @ np.linalg.solve(alone.covariance[:eigenheads, :eigenheads], apart) / eigenheads))


def solution_of(head: HeadFit) -> ContourSolution:
    """Returns the contour solver's solution in a capture's fit. Raises InputError for a fit by the simplex method."""
    if head.solution is None:
        raise InputError("take", [compose("take-needs-contour")])
    return head.solution


@contextmanager
def name_errors(name: str) -> Iterator[None]:
    """Prefixes the messages of errors in the ``with`` block with the capture's name."""
    try:
        yield
    except Cancelled:
        raise
    except EigenheadError as error:
        raise EigenheadError(compose("located", where=name, fault=error.message)) from error


def _moment(name: str, result: Reconstruction, apart: float) -> Moment:
    fit, posed = result.head.fit, np.asarray(result.head.model.posed, int)
    weights, spread = np.zeros(len(result.head.model.expressions)), np.zeros(len(result.head.model.expressions))
    if len(posed) and fit.covariance is not None:
        weights, spread = fit.coefficients[posed], np.sqrt(np.diag(fit.covariance)[posed])
    return Moment(
        name,
        result.refined.detail.level,
        weights,
        spread,
        fit.world_from_head,
        head_from_world(result).apply(result.mesh_world.vertices),
        result.refined.deviation_mm,
        apart,
        result.warnings,
    )


def _own_shapes(model: HeadModel, joint: Sequence[ContourSolution], moments: Sequence[Moment]) -> OwnShapes:
    longest = max(joint, key=lambda each: len(each.state.coefficients))
    fitted, scale = longest.problem.model, longest.state.world_from_head.scale
    coefficients = longest.state.coefficients.copy()
    coefficients[np.asarray(fitted.posed, int)] = 0.0
    return estimate_own_shapes(
        model,
        scale * fitted.vertices(coefficients),
        scale,
        np.stack([each.weights for each in moments]),
        np.stack([each.head for each in moments]),
        np.stack([each.deviation_mm for each in moments]),
    )


class _Advance:
    """Converts the progress of each capture's stages to the progress of the take, which never decreases."""

    def __init__(self, report: Progress, count: int) -> None:
        self._report, self._count, self._most = report, count, 0.0

    def of(self, name: str, number: int) -> Progress:
        """Returns the progress function for the capture ``number`` (0 for the first)."""

        def tell(stage: str, fraction: float) -> None:
            for stages, (first, last) in ((OBSERVED, (0.0, SHARES[0])), (DELIVERED, (SHARES[1], 1.0))):
                if stage in stages:
                    done = (number + (stages.index(stage) + fraction) / len(stages)) / self._count
                    self._most = max(self._most, first + (last - first) * done)
            self._report(f"{name} {stage}", self._most)

        return tell
