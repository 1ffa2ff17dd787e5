"""Photographs inside the outline: planted bumps, noise, gains, occlusion, moved cameras, hair."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.contour import ContourSolution
from pipeline.contour_fit.problem import Stage, State, SurfaceObservations
from pipeline.contour_fit.surface_term import SurfaceTerm
from pipeline.estimation.terms import NormalEquations
from pipeline.head_model.model import HeadModel
from pipeline.photometric_fit.depth_search import choose_views, correlate, facing_of, sample_visibility
from pipeline.photometric_fit.patches import Patches, spread_samples, under_hair
from pipeline.photometric_fit.refine import (
    LOST_MM,
    ROUNDS,
    finer,
    local_misfit_mm,
    refine_with_photographs,
    rounds_of_rig,
)
from pipeline.warnings import Detail
from rig.geometry import RigidTransform, Similarity, rotation_from_vector
from rig.studio.scene.layout import rig_from_directions
from tests.support.changed_rigs import reposed
from tests.support.photo_scene import Scene, bumped, ellipsoid_model, glossy, photograph, shading, texture
from tests.support.scenes import ellipsoid


@pytest.fixture(scope="module")
def model() -> HeadModel:
    return ellipsoid_model()


@pytest.fixture(scope="module")
def bump(model: HeadModel) -> Scene:
    return photograph(model, bumped(model, 2.0), texture)


@pytest.fixture(scope="module")
def refined(bump: Scene) -> tuple[ContourSolution, Detail]:
    return refine_with_photographs(bump.start(), bump.images)


def test_a_bump_inside_the_outline_is_found(bump: Scene, refined: tuple[ContourSolution, Detail]) -> None:
    """A pixel is 0.9 mm; views 25 degrees apart see 1 mm of depth as 0.5 px. Matched to 0.1 px, by 30 independent
    samples a patch and ten views, that is 0.05 mm; the basis (9 mm) follows a bump of 14 mm almost wholly."""
    solved, detail = refined
    before, after = bump.error(bump.start()), bump.error(solved)
    raised = before < -0.5
    assert detail.level == "photo"
    assert np.abs(before[raised]).mean() > 1.0
    assert np.abs(after[raised]).mean() < 0.12
    assert np.sqrt((after**2).mean()) < 0.12


def test_gloss_before_three_narrow_cameras_is_no_relief(model: HeadModel) -> None:
    """A lobe of 10 degrees that moves with the camera, 75 levels on a texture of 2: with shading the surface follows it
    by 1.5 mm, 0.8 at 95 %."""
    rig = rig_from_directions([(-12.0, 0.0), (0.0, 0.0), (12.0, 0.0)], distance_mm=600.0)
    truth = model.vertices(np.zeros(0))
    scenes = [photograph(model, truth, glossy(camera.centre_world), noise=0.004, rig=rig) for camera in rig]
    seen = {camera.name: scene.images[camera.name] for camera, scene in zip(rig, scenes, strict=True)}
    solved, detail = refine_with_photographs(scenes[0].start(), seen)
    off = np.abs(scenes[0].error(solved))
    assert detail.level == "photo"
    assert np.quantile(off, 0.95) < 0.35
    assert off.max() < 0.8


def test_a_usual_rig_is_searched_as_ever_and_a_narrow_one_farther_and_without_shading() -> None:
    assert rounds_of_rig(1.02) == tuple(replace(each, reach_mm=1.02 * each.reach_mm) for each in ROUNDS)
    rounds = rounds_of_rig(3.0)
    assert rounds[0].reach_mm == 3.0 * ROUNDS[0].reach_mm
    assert len(rounds) == len(ROUNDS) + 4
    assert not any(each.with_shading for each in rounds)


def test_gains_of_cameras_do_not_matter(model: HeadModel, bump: Scene, refined: tuple[ContourSolution, Detail]) -> None:
    """The same noise at another gain moves an observation by a part of its own noise, no more."""
    gains = np.random.default_rng(0).uniform(0.7, 1.3, len(bump.rig))
    other = photograph(model, bump.truth, texture, gains=gains)
    two, _ = refine_with_photographs(other.start(), other.images)
    assert np.sqrt(((bump.error(refined[0]) - other.error(two)) ** 2).mean()) < 0.05


def test_a_smooth_shaded_surface_stays_smooth(model: HeadModel) -> None:
    """No texture, only shading and noise: what is left of it in the surface is under 0.05 mm RMS."""
    scene = photograph(model, model.vertices(np.zeros(0)), shading)
    solved, _ = refine_with_photographs(scene.start(), scene.images)
    error = scene.error(solved)
    assert np.sqrt(((error - error.mean()) ** 2).mean()) < 0.05


@pytest.mark.parametrize("kind", ["noise", "masks", "missing"])
def test_pictures_that_show_nothing_leave_the_fit_as_it_was(model: HeadModel, kind: str) -> None:
    scene = photograph(model, model.vertices(np.zeros(0)), lambda p, n: np.full(len(p), 0.5))
    images = {
        "noise": scene.images,
        "masks": {n: np.repeat(s.mask[:, :, None], 3, axis=2) * np.uint8(255) for n, s in scene.silhouettes.items()},
        "missing": {},
    }[kind]
    start = scene.start()
    solved, detail = refine_with_photographs(start, images)
    assert solved is start
    assert detail.level == "kernel"
    assert "needed" in detail.reason.text


def test_a_moved_camera_moves_nothing(model: HeadModel, bump: Scene, refined: tuple[ContourSolution, Detail]) -> None:
    """One camera turned by 0.4 px (twice the calibration's prior), another by -0.3: they are found to 0.15 px, and the
    surface is no worse than 1.3 times that of exact cameras, plus 0.02 mm for chance."""
    rig = bump.rig
    focal = rig["cam02"].intrinsics.fx
    turns = {"cam02": np.array([0.0, 0.4 / focal, 0.0]), "cam05": np.array([-0.3 / focal, 0.0, 0.0])}
    moved = rig
    for name, vector in turns.items():
        turn = RigidTransform(rotation_from_vector(vector), np.zeros(3))
        moved = reposed(moved, lambda pose, turn=turn: turn @ pose, name)
    scene = photograph(model, bumped(model, 2.0), texture, true_rig=moved)
    solved, _ = refine_with_photographs(scene.start(), scene.images)
    rms = [np.sqrt((s.error(f) ** 2).mean()) for s, f in ((bump, refined[0]), (scene, solved))]
    assert rms[1] < 1.3 * rms[0] + 0.02
    points = scene.truth[model.levels["full"].face_region]
    for k, camera in enumerate(rig):
        found = camera.moved(solved.state.camera_shift[k])
        assert np.linalg.norm((found.project(points) - moved[camera.name].project(points)).mean(axis=0)) < 0.15


def test_what_is_hidden_is_not_seen(bump: Scene) -> None:
    """Samples behind a plate that covers the left half of the picture, or on the far side, do not face the camera."""
    start = bump.start()
    _, patches, _ = finer(start.problem.model)
    visibility = sample_visibility(start.problem, start.state, patches, np.ones(len(bump.rig), bool))
    k, camera = 3, bump.rig["cam03"]
    towards = camera.centre_world - visibility.points
    outward = patches.normals(visibility.normals)
    cosine = (outward * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    np.testing.assert_allclose(
        visibility.facing[k][visibility.facing[k] > 0], cosine[visibility.facing[k] > 0], atol=1e-6
    )
    assert not visibility.facing[k][cosine <= 0].any()
    assert (visibility.facing[k][cosine > 0.4] > 0).all()
    plate = np.where(np.arange(640) < 320, 900.0, np.inf)[None].repeat(480, axis=0).astype(np.float32)
    seen = facing_of(visibility.points, outward, camera, plate, np.full((480, 640), -50.0, np.float32))
    left = camera.project(visibility.points)[:, 0] < 315
    assert not seen[left].any()
    assert seen[~left].any()


def test_correlation_of_planted_signals() -> None:
    """Two views with the same signal correlate fully at no shift, also under gain and offset; independent noise does
    not; the noise level in the norm makes a flat patch mute."""
    rng = np.random.default_rng(1)
    signal, noise = rng.standard_normal(400), rng.standard_normal((400, 2))
    patch = Patches(
        np.zeros((400, 3), np.int32), np.zeros((400, 3)), np.zeros(1, int), np.array([0, 400]), np.arange(400),
        np.zeros(400), np.ones(400),
    )  # fmt: skip
    weights, facing = np.ones(400), np.ones((2, 400), np.float32)
    grey = np.zeros((400, 2, 3), np.float32)
    grey[:, 0] = (10 * signal)[:, None]
    grey[:, 1, 1] = 7 * signal + 50
    grey[:, 1, 0], grey[:, 1, 2] = 10 * noise.T
    view, value = choose_views(patch, weights, facing, 0.85, 5)
    assert view.tolist() == [[0, 1]]
    score = correlate(patch, weights, view, value, facing > 0, grey=grey, noise=np.zeros(2))
    assert score[0, 1] == pytest.approx(1.0, abs=1e-5)
    assert np.abs(score[0, [0, 2]]).max() < 4 / np.sqrt(400)
    muted = correlate(patch, weights, view, value, facing > 0, grey=grey, noise=np.full(2, 1000.0))
    assert muted.max() < 1e-3


def test_correlation_is_the_mean_of_all_pairs_of_views() -> None:
    """By the pairs' correlations themselves, each worth the product of its views' values; a sample that a view does
    not see is even there."""
    rng = np.random.default_rng(4)
    samples, views, steps = 60, 4, 3
    patch = Patches(
        np.zeros((samples, 3), np.int32), np.zeros((samples, 3)), np.zeros(1, int), np.array([0, samples]),
        np.arange(samples), np.zeros(samples), np.ones(samples),
    )  # fmt: skip
    weights, seen = rng.uniform(0.1, 1.0, samples), rng.random((views, samples)) < 0.9
    common = rng.standard_normal((samples, 1, steps))
    grey = (100.0 + 20.0 * (common + rng.standard_normal((samples, views, steps)))).astype(np.float32)
    view, value, noise = np.array([[2, 0, 3, 1]]), np.array([[0.9, 0.8, 0.5, 0.3]]), np.array([1.0, 2.0, 3.0, 4.0])
    alike, shared = np.zeros(steps), 0.0
    units = {}
    for k in range(views):
        weight = weights * seen[k]
        shade = (grey[:, k] - weight @ grey[:, k] / weight.sum()) * seen[k][:, None]
        units[k] = shade / np.sqrt(weights @ shade**2 + weight.sum() * noise[k] ** 2)
    for q in range(views):
        for r in range(q):
            pair = value[0, q] * value[0, r]
            alike += pair * (weights[:, None] * units[view[0, q]] * units[view[0, r]]).sum(axis=0)
            shared += pair
    found = correlate(patch, weights, view, value, seen, grey=grey, noise=noise)
    np.testing.assert_allclose(found[0], alike / shared, atol=1e-5)


def test_a_bound_pulls_a_head_in_that_stands_out_of_it_and_lets_one_inside_alone(model: HeadModel) -> None:
    rows, count = np.array([40, 300, 900]), 3
    vertices = model.vertices(np.zeros(0))[rows]
    seen = SurfaceObservations(
        vertex=rows, basis=model.basis("full", 6, rows), mean=vertices, normal=np.tile([0.0, 0.0, 1.0], (count, 1)),
        seen_at=vertices, displacement=np.array([-2.0, 3.0, 3.0]), information=np.full(count, 4.0),
        bound=np.array([True, True, False]), by_camera=np.zeros((count, 6)), camera_shift=np.zeros((1, 6)),
        camera_matrix=np.zeros((6, 6)), camera_gradient=np.zeros(6),
    )  # fmt: skip
    here = SurfaceTerm(seen, _stage(6)).at(State(np.zeros(6), Similarity.identity(), np.zeros((1, 6))))
    np.testing.assert_allclose(here.residual, [2.0, 0.0, -3.0], atol=1e-5)  # 2 mm out, 3 mm inside, a place 3 mm off

    each = replace(seen, bound=np.array([True, True, True]))
    one = NormalEquations.empty(6 + 7 + 6)
    SurfaceTerm(each, _stage(6)).at(here.state).add_to(one)
    alone = NormalEquations.empty(6 + 7 + 6)
    kept = replace(seen, information=np.array([4.0, 0.0, 0.0]))
    SurfaceTerm(kept, _stage(6)).at(here.state).add_to(alone)
    np.testing.assert_array_equal(one.matrix, alone.matrix)  # the two that are kept have no say
    np.testing.assert_array_equal(one.gradient, alone.gradient)
    assert np.abs(one.gradient).max() > 0.0


def _stage(modes: int) -> Stage:
    return Stage("p95", modes, True, (1.5,), False, True, 3)


@pytest.mark.parametrize(("subdivisions", "spacing"), [(3, 2.0), (5, 4.0)])
def test_samples_are_spread_evenly(subdivisions: int, spacing: float) -> None:
    """One in spacing squared, whether triangles are larger or smaller than that."""
    mesh = ellipsoid(subdivisions)
    a, b, c = (mesh.vertices[mesh.faces[:, j]] for j in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    corners, shares = spread_samples(mesh.vertices, mesh.faces, spacing)
    assert len(corners) == pytest.approx(area / spacing**2, rel=0.25)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


def test_a_place_that_no_photograph_finds_again_is_misfit_there_and_nowhere_else(model: HeadModel) -> None:
    """The surface is seen 0.1 mm off all over the front's upper half; at the chin nothing matches."""
    vertices = model.vertices(np.zeros(0))
    off_mm = 0.1
    seen = np.flatnonzero((vertices[:, 2] > 0.0) & (vertices[:, 1] > 0.0))
    lost = np.flatnonzero((vertices[:, 2] > 0.0) & (vertices[:, 1] < -60.0))
    count, nothing = len(seen), np.zeros((len(seen), 6))
    observed = SurfaceObservations(
        seen, np.zeros((len(model.modes), count, 3), np.float32), vertices[seen], np.tile([0.0, 0.0, 1.0], (count, 1)),
        vertices[seen], np.full(count, off_mm), np.ones(count), np.zeros(count, bool), nothing,
        np.zeros((1, 6)), np.eye(6), np.zeros(6),
    )  # fmt: skip
    state = State(np.zeros(len(model.modes)), Similarity.identity(), np.zeros((1, 6)))
    misfit, cage = local_misfit_mm(model, observed, state, lost), model.mean
    front = cage[:, 2] > 10.0
    assert misfit[front & (cage[:, 1] > 20.0)].max() < 1.5 * off_mm
    assert misfit[front & (cage[:, 1] < -70.0)].max() > 0.7 * LOST_MM


def row_of_patches(count: int) -> tuple[Patches, np.ndarray]:
    """One sample a patch, 3 mm apart along x."""
    each, ones = np.arange(count), np.ones(count)
    corners = np.repeat(each[:, None], 3, axis=1).astype(np.int32)
    patches = Patches(corners, np.full((count, 3), 1 / 3), each, np.arange(count + 1), each, np.zeros(count), ones)
    return patches, np.column_stack([3.0 * each, np.zeros((count, 2))])


def test_a_patch_is_hairs_where_most_views_say_so_and_next_to_it() -> None:
    patches, centres = row_of_patches(20)
    pixel = np.zeros((3, 20, 2))
    pixel[:, :, 0] = np.arange(20)
    seen = np.ones((3, 20), bool)
    seen[2, 10:] = False
    first, second = np.zeros((1, 20), np.float32), np.zeros((1, 20), np.float32)
    first[0, [3, 12]], second[0, [3, 12]] = 1.0, (0.8, 0.1)
    third = (np.arange(20) != 7)[None].astype(np.float32)  # calls all hair, and is outvoted, or does not see it
    third[0, :10] *= np.arange(10) == 3
    found = under_hair(patches, {"a": first, "b": second, "c": third}, ("a", "b", "c"), pixel, seen, centres)
    assert np.flatnonzero(found).tolist() == [2, 3, 4, 11, 12, 13]  # 0.55 at patch 12, and 5 mm about both
    patches, centres = row_of_patches(5)
    found = under_hair(patches, {}, ("a",), np.zeros((1, 5, 2)), np.ones((1, 5), bool), centres)
    assert not found.any()
