"""The joint fit of planted heads before three cameras, from their true outlines at 160 x 120 pixels."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.applications.moments.joint_fit import build_joint_problem, fit_jointly, identity_of, joint_covariances
from pipeline.applications.moments.take import OTHER_PERSON, measure_difference
from pipeline.contour_fit.contour import ContourSolution, finish, last_problem, solve_contour
from pipeline.contour_fit.prior_term import LOG_SCALE, SCALE_SPREAD
from pipeline.contour_fit.problem import POSE
from pipeline.head_model.gaussian_process import basis_of
from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.settings import FittingSettings
from rig.geometry import Similarity, rotation_from_vector
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from tests.support.subjects import exact

EIGENHEADS, SPREAD = 20, 0.8
SETTINGS = FittingSettings(modes=EIGENHEADS)
EXPRESSIONS = ({}, {"jawOpen": 0.5}, {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}, {"mouthPucker": 0.9})


@pytest.fixture(scope="module")
def wide(model: HeadModel) -> HeadModel:
    return basis_of(model, EIGENHEADS, kernel=True)


def photographed(
    wide: HeadModel, identity: np.ndarray, weights: dict[str, float], seed: int, renderer: Renderer
) -> ContourSolution:
    """The contour solver's fit to the outlines of a head that has turned a little."""
    rng, rig = np.random.default_rng(seed), exact(default_layout().subset(["cam00", "cam03", "cam04"]).scaled(0.15625))
    turn = rotation_from_vector(0.1 * rng.standard_normal(3))
    pose = Similarity(1.0, turn, 6.0 * rng.standard_normal(3))
    with renderer.silhouette_set(rig, wide.levels["full"].faces) as drawn:
        masks = drawn.masks(pose.apply(wide.posed_vertices(identity, weights)))
    silhouettes = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
    start = replace(pose, translation=pose.translation + (2.0, -2.0, 2.0))
    return solve_contour(wide, start, silhouettes, rig, SETTINGS)


@pytest.fixture(scope="module")
def identity() -> np.ndarray:
    return SPREAD * np.random.default_rng(3).standard_normal(EIGENHEADS)


@pytest.fixture(scope="module")
def alone(wide: HeadModel, identity: np.ndarray, renderer: Renderer) -> tuple[ContourSolution, ...]:
    return tuple(photographed(wide, identity, each, k, renderer) for k, each in enumerate(EXPRESSIONS))


@pytest.fixture(scope="module")
def joint(alone: tuple[ContourSolution, ...]) -> tuple[ContourSolution, ...]:
    return fit_jointly(alone, EIGENHEADS)


def neutral_error(wide: HeadModel, solved: ContourSolution, identity: np.ndarray) -> float:
    """The mean distance (mm) of the neutral face from the true one, aligned."""
    found = solved.state.coefficients.copy()
    found[np.asarray(wide.posed)] = 0.0
    face = wide.levels["full"].face_region
    head, truth = (wide.vertices(each)[face] for each in (found, identity))
    at, to = head - head.mean(axis=0), truth - truth.mean(axis=0)
    left, _, right = np.linalg.svd(at.T @ to)
    return float(np.linalg.norm(at @ left @ right - to, axis=1).mean())


def test_moments_share_one_identity_that_is_nearer_than_their_own(alone, joint, wide, identity) -> None:
    first = identity_of(joint[0], joint[0].state)
    for each in joint:
        assert np.array_equal(identity_of(each, each.state), first)
        assert each.state.world_from_head.scale == pytest.approx(joint[0].state.world_from_head.scale, rel=1e-12)
        weights = each.state.coefficients[np.asarray(wide.posed)]
        assert weights.min() >= 0.0
        assert weights.max() <= 1.0
    single = np.mean([neutral_error(wide, each, identity) for each in alone])
    assert neutral_error(wide, joint[0], identity) < 0.9 * single


@pytest.mark.parametrize("common", [0.0, 0.25, 1.0])
def test_the_prior_of_what_is_shared_counts_by_what_is_common(alone, common: float) -> None:
    """Two copies of one moment: twice its evidence, and the prior once if nothing is common."""
    twice = (alone[1], alone[1])
    problem, layout = build_joint_problem(twice, common)
    here, off = problem.at(tuple(each.state for each in twice)), 1.0 - common
    found, (single, there) = problem.equations(here), last_problem(alone[1])
    alone_equations, shared = single.equations(there), layout.identity
    rows = np.flatnonzero(layout.places[0] < shared)
    values = alone[1].state.coefficients[rows]
    assert np.allclose(
        found.matrix[:shared, :shared], 2.0 * alone_equations.matrix[np.ix_(rows, rows)] - off * np.eye(shared)
    )
    assert np.allclose(found.gradient[:shared], 2.0 * alone_equations.gradient[rows] - off * values)
    scale = alone[1].stage.modes + LOG_SCALE
    assert found.matrix[shared, shared] == pytest.approx(
        2.0 * alone_equations.matrix[scale, scale] - off * SCALE_SPREAD**-2
    )
    assert not found.matrix[np.ix_(layout.free[0], layout.free[1])].any()
    log_scale = np.log(alone[1].state.world_from_head.scale)
    prior = values @ values + (log_scale / SCALE_SPREAD) ** 2
    assert here.cost == pytest.approx(2.0 * there.cost - off * prior)


def test_a_moment_knows_more_of_itself_with_the_others(alone, joint) -> None:
    for covariance, each in zip(joint_covariances(joint), alone, strict=True):
        before = finish(each).covariance
        assert before is not None
        assert covariance.shape == before.shape == (each.stage.modes + POSE,) * 2
        known = np.diag(covariance)[:EIGENHEADS].sum()
        assert 0.0 < known < np.diag(before)[:EIGENHEADS].sum()


def test_another_person_is_told_from_the_others(alone, wide, renderer) -> None:
    stranger = photographed(wide, SPREAD * np.random.default_rng(8).standard_normal(EIGENHEADS), {}, 9, renderer)
    among = (*alone[:3], stranger)
    found = [
        measure_difference(finish(one), other, EIGENHEADS)
        for one, other in zip(among, fit_jointly(among, EIGENHEADS), strict=True)
    ]
    assert found[3] > OTHER_PERSON
    assert found[3] > 2.0 * max(found[:3])
