"""Every term of every problem against central differences of its own residuals.

Whoever adds a term adds a line to ``CASES``: a term at a planted value, where its unknowns move it, and steps whose
third order is below the tolerance.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from calibration.adjustment.bundle import CornerTerm, places
from calibration.adjustment.lens_prior import AspectTerm
from calibration.adjustment.state import PER_CAMERA as PER_BUNDLE_CAMERA
from calibration.adjustment.state import PER_SHOT, BundleState, Observations, moved_state, observe_views
from calibration.silhouette_refinement.tangency_term import PackedTangencies, TangencyTerm
from pipeline.contour_fit.head_problem import FeatureTerm, apply_step
from pipeline.contour_fit.landmark_term import LandmarkTerm, observe_landmarks
from pipeline.contour_fit.prior_term import PriorTerm
from pipeline.contour_fit.problem import (
    PER_CAMERA,
    POSE,
    ContourProblem,
    Stage,
    State,
    SurfaceObservations,
    first_evidence,
    make_problem,
    moved_views,
)
from pipeline.contour_fit.rim_kernels import projected_with_slopes
from pipeline.contour_fit.rim_term import observed_rim, rim_rows
from pipeline.contour_fit.surface_term import SurfaceTerm, surface_rows
from pipeline.estimation.terms import NormalEquations, Residuals
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from pipeline.view_checks.camera_drift import ShiftEquations, ShiftTerm
from rig.geometry import Similarity, rotation_from_vector
from tests.support.board_sessions import planted, session
from tests.support.photo_scene import ellipsoid_model
from tests.support.scenes import fan


@dataclass(frozen=True)
class Case:
    """``residuals(step)``: the residuals after a step of all unknowns; ``jacobian``: theirs, at no step."""

    residuals: Callable[[np.ndarray], np.ndarray]
    jacobian: np.ndarray
    steps: np.ndarray
    tolerance: float = 1e-6  # of the largest entry of a column


def case(term: Any, value: Any, moved: Callable[[Any, np.ndarray], Any], steps: np.ndarray) -> Case:
    here: Residuals = term.at(value)
    jacobian = here.jacobian().reshape(here.residual.size, -1)
    return Case(lambda step: term.at(moved(value, step)).residual.ravel(), jacobian, steps)


def image_shift() -> Case:
    rng = np.random.default_rng(1)
    normals, outward = rng.normal(size=(8, 2)), rng.choice([-1.0, 1.0], 8)
    term = ShiftTerm(ShiftEquations(normals, outward, rng.normal(size=8), rng.uniform(1.0, 2.0, 8), 0.4))
    return case(term, np.array([3.0, -1.0]), np.add, np.full(2, 1e-2))


def tangency(focal: bool) -> Case:
    """Both cameras' pixels of the same points: where the residual is zero, its gain is constant to first order."""
    rig, points = fan(640, 480), np.random.default_rng(2).normal(0.0, 60.0, (12, 3))
    cameras = np.array([[k % 7, (k + 1 + k % 3) % 7] for k in range(12)])
    pixels = np.array(
        [[rig.cameras[k].project(p[None])[0] for k in pair] for p, pair in zip(points, cameras, strict=True)]
    )
    term = TangencyTerm(PackedTangencies(cameras, pixels, np.full(12, 1e-3)), rig, focal, 0.2)
    steps = np.tile([1e-5, 1e-5, 1e-5, 1e-2, 1e-2, 1e-2, *([1e-5] if focal else [])], 7)
    return case(term, np.zeros(len(steps)), np.add, steps)


def small_bundle() -> tuple[BundleState, Observations]:
    """Three cameras, five shots, the board in motion, some corners off."""
    source, velocities = session(cameras=3, shots=5, seed=1), np.random.default_rng(0).normal(size=(5, 6))
    d, state = source.detections, replace(planted(source), velocities=velocities * [0.01, 0.01, 0.01, 10, 10, 10])
    return state, observe_views(d.views, source.rig.names, d.shots, d.board)


def corners() -> Case:
    state, seen = small_bundle()
    term = CornerTerm(seen, np.full(3, 0.2))
    per_camera = [*[1e-2] * 4, *[1e-4] * 5, *[1e-5] * 3, *[1e-2] * 3]
    steps = np.array([*per_camera * 3, *[*[1e-5] * 3, *[1e-2] * 3] * 5, *[1e-4] * 3])
    jacobian = np.zeros((2 * len(seen.pixels), len(steps)))
    rows, at = jacobian.reshape(-1, 2, len(steps)), places(seen, 3, len(steps))[seen.view_of]
    np.put_along_axis(rows, at[:, None], term.at(state).by_view(), axis=2)
    return Case(lambda step: term.at(moved_state(state, step)).residual.ravel(), jacobian, steps, 1e-5)


def aspects() -> Case:
    state, _ = small_bundle()
    here = AspectTerm().at(state)
    jacobian = np.zeros((3, 3 * PER_BUNDLE_CAMERA + 5 * PER_SHOT + 3))
    for k, slope in enumerate(here.slopes()):
        jacobian[k, k * PER_BUNDLE_CAMERA : k * PER_BUNDLE_CAMERA + 2] = slope
    return Case(
        lambda step: AspectTerm().at(moved_state(state, step)).residual, jacobian, np.full(jacobian.shape[1], 1e-3)
    )


def head() -> tuple[ContourProblem, Stage, State]:
    """An ellipsoid, its one mode and the kernel's, cameras a little off, six landmarks picked 2 px off."""
    model, rig, rng = ellipsoid_model(3), fan(640, 480), np.random.default_rng(5)
    names = dict(zip(("pronasale", "gnathion", "nasion"), (3, 40, 90), strict=True))
    model = replace(model, landmarks=names)
    at = model.vertices(np.zeros(0))
    features = {
        name: {camera.name: camera.project(at[[row]])[0] + 2.0 for camera in rig} for name, row in names.items()
    }
    flat = np.zeros((480, 640), np.float32)
    silhouettes = {camera.name: Silhouette(flat < 0, flat) for camera in rig}
    problem = make_problem(model, Similarity.identity(), silhouettes, rig, FittingSettings(), features)
    modes = 8
    stage = Stage("full", modes, True, (1.5,), True, True, 3)
    pose = Similarity(1.01, rotation_from_vector(np.array([0.05, -0.1, 0.02])), np.array([3.0, -2.0, 5.0]))
    shift = rng.normal(size=(len(rig), 6)) * [1e-3, 1e-3, 1e-3, 0.5, 0.5, 0.5]
    return problem, stage, State(0.3 * rng.normal(size=modes), pose, shift)


def head_steps(problem: ContourProblem, stage: Stage) -> np.ndarray:
    camera = [1e-5] * 3 + [1e-2] * 3
    return np.array([*[1e-2] * stage.modes, *[1e-5] * 3, *[1e-2] * 3, 1e-4, *camera * len(problem.views.names)])


def rim_of_a_head() -> Case:
    """Where the outline lies along its normal, of samples that stay where they are on the mesh; with cameras where the
    calibration has them, since a correction is a left perturbation of its own camera and no sum of two."""
    problem, stage, state = head()
    state = replace(state, camera_shift=np.zeros_like(state.camera_shift))
    rim = observed_rim(problem, first_evidence(problem.settings), state, stage)
    rows = rim_rows(problem, state, rim, stage)
    steps, shared = head_steps(problem, stage), stage.modes + POSE
    jacobian = np.zeros((len(rows), len(steps)))
    jacobian[:, :shared] = rows[:, :shared]
    columns = shared + PER_CAMERA * rim.view[:, None] + np.arange(PER_CAMERA)
    jacobian[np.arange(len(rows))[:, None], columns] = rows[:, shared:]
    share = np.stack([1.0 - rim.blend, rim.blend], axis=1)[:, :, None]

    def on_mesh(at: State) -> np.ndarray:
        return (share * problem.bases[stage.level].vertices(at.coefficients)[rim.corner]).sum(axis=1)

    lift = state.world_from_head.inverse().apply(rim.point) - on_mesh(state)  # over the chord, along the normal

    def residuals(step: np.ndarray) -> np.ndarray:
        moved = apply_step(state, step, stage)
        points = moved.world_from_head.apply(on_mesh(moved) + lift)
        pixels, _ = projected_with_slopes(points, rim.view, moved_views(problem, moved).packed())
        return (rim.normal * pixels).sum(axis=1)

    return Case(residuals, jacobian, steps, 1e-3)  # the modes are summed in single precision


def features_of_a_head() -> Case:
    """With the deviation in pixels, which the Jacobian takes for constant, held where it is."""
    problem, stage, state = head()
    state = replace(state, camera_shift=np.zeros_like(state.camera_shift))
    picked = problem.features
    assert picked is not None
    term = FeatureTerm(problem, picked, stage, landmark_noise_mm=0.0)
    return replace(
        case(term, state, lambda s, step: apply_step(s, step, stage), head_steps(problem, stage)), tolerance=1e-4
    )


def landmarks_of_a_head() -> Case:
    """Places within triangles, found some mm off, with covariances that are no multiples of the identity."""
    problem, stage, state = head()
    rng, faces = np.random.default_rng(7), problem.model.levels["full"].faces
    corner, blend = faces[::40], rng.dirichlet(np.ones(3), len(faces[::40]))
    found = (problem.model.vertices(np.zeros(0))[corner] * blend[:, :, None]).sum(axis=1)
    spread = rng.standard_normal((3 * len(corner), 3 * len(corner)))
    covariance = spread @ spread.T / len(corner) + np.eye(len(spread))
    observed = observe_landmarks(problem.model, corner, blend, found + rng.normal(0.0, 2.0, found.shape), covariance)
    term = LandmarkTerm(observed, stage, len(problem.views.names))
    return replace(
        case(term, state, lambda s, step: apply_step(s, step, stage), head_steps(problem, stage)), tolerance=1e-4
    )


def surface_of_a_head() -> Case:
    problem, stage, state = head()
    rng, rows, cameras = np.random.default_rng(6), np.arange(0, 600, 20), 6 * len(problem.views.names)
    model = problem.model
    normal = rng.standard_normal((len(rows), 3))
    seen = SurfaceObservations(
        vertex=rows, basis=model.basis("full", stage.modes, rows), mean=model.vertices(np.zeros(0))[rows],
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True), seen_at=model.vertices(np.zeros(0))[rows],
        displacement=rng.standard_normal(len(rows)), information=np.ones(len(rows)), bound=np.zeros(len(rows), bool),
        by_camera=rng.standard_normal((len(rows), cameras)), camera_shift=np.zeros_like(state.camera_shift),
        camera_matrix=np.eye(cameras), camera_gradient=np.zeros(cameras),
    )  # fmt: skip
    here = SurfaceTerm(seen, stage).at(state)
    jacobian = surface_rows(seen, stage.modes, state.world_from_head, here.points, cameras=True).astype(float)

    def residuals(step: np.ndarray) -> np.ndarray:
        return SurfaceTerm(seen, stage).at(apply_step(state, step, stage)).residual

    return Case(residuals, jacobian, 100.0 * head_steps(problem, stage), 1e-3)  # single precision


CASES: dict[str, Callable[[], Case]] = {
    "shift of an image": image_shift,
    "tangency": lambda: tangency(False),
    "tangency with focal lengths": lambda: tangency(True),
    "corners of boards": corners,
    "square pixels": aspects,
    "rim of a head": rim_of_a_head,
    "feature points of a head": features_of_a_head,
    "landmarks of a head": landmarks_of_a_head,
    "surface in photographs": surface_of_a_head,
}


@pytest.mark.parametrize("make", CASES.values(), ids=CASES.keys())
def test_jacobians_are_central_differences(make: Callable[[], Case]) -> None:
    subject = make()
    assert subject.jacobian.shape[1] == len(subject.steps)
    for column, by in enumerate(subject.steps):
        step = np.zeros(len(subject.steps))
        step[column] = by
        slope = (subject.residuals(step) - subject.residuals(-step)) / (2.0 * by)
        scale = max(np.abs(subject.jacobian[:, column]).max(), 1e-9)
        np.testing.assert_allclose(subject.jacobian[:, column] / scale, slope / scale, atol=subject.tolerance)


def test_the_priors_normal_equations_are_differences_of_its_cost() -> None:
    """A prior has no Jacobian, but its cost is a quadratic: half its central differences are the gradient, and those of
    the gradient the matrix, to rounding."""
    problem, stage, state = head()
    rng = np.random.default_rng(8)
    known = rng.normal(size=(len(problem.views.names), PER_CAMERA, PER_CAMERA))
    problem = replace(problem, camera_information=known @ known.transpose(0, 2, 1))
    term, count, by = PriorTerm(problem, stage), len(head_steps(problem, stage)), 1e-2

    def after(place: int, step_by: float) -> tuple[float, NormalEquations]:
        step = np.zeros(count)
        step[place] = step_by
        at, equations = term.at(apply_step(state, step, stage)), NormalEquations.empty(count)
        at.add_to(equations)
        return at.cost, equations

    _, here = after(0, 0.0)
    for place in range(count):
        (cost_up, up), (cost_down, down) = after(place, by), after(place, -by)
        np.testing.assert_allclose(here.gradient[place], (cost_up - cost_down) / (4 * by), rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(
            here.matrix[:, place], (up.gradient - down.gradient) / (2 * by), rtol=1e-6, atol=1e-8
        )


def test_the_prior_of_weights_is_the_tangent_of_its_cost() -> None:
    """Half the slope of the cost; and no curvature beside the Gaussian's, since the logarithm's is negative."""
    problem, stage, state = head()
    state = replace(state, coefficients=np.abs(state.coefficients))
    problem = replace(problem, model=replace(problem.model, posed=range(3, 6)))
    term, count, by = PriorTerm(problem, stage), len(head_steps(problem, stage)), 1e-4
    here = NormalEquations.empty(count)
    term.at(state).add_to(here)
    for place in range(stage.modes):
        step = np.zeros(count)
        step[place] = by
        up, down = (term.at(apply_step(state, sign * step, stage)).cost for sign in (1.0, -1.0))
        np.testing.assert_allclose(here.gradient[place], (up - down) / (4 * by), rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(np.diag(here.matrix)[: stage.modes], 1.0)
