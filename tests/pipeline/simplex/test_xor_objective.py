"""The paper's objective: the renderer's sum against numpy's, what may speak, and the whole two-level fit."""

import numpy as np
import pytest

from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import (
    Silhouette,
    ViewQuality,
    boundary_weighted_xor,
    boundary_weights,
    signed_distance,
    silhouette_from_mask,
)
from pipeline.settings import FittingSettings
from pipeline.simplex.hierarchy import HIERARCHY, LIMIT, fit_simplex
from pipeline.simplex.xor_objective import SilhouetteObjective, close_holes, face_pixels, mask_at_scale
from rig.camera import Camera, Intrinsics
from rig.errors import Cancelled
from rig.geometry import Similarity, look_at, rotation_from_vector
from rig.render.renderer import Renderer, is_closed
from rig.rig import Rig
from tests.support.oracles import camera_depth

pytestmark = pytest.mark.gl

# azimuth, elevation: the front hemisphere, as in section 5.3 (a)
PLACES_DEG = [
    *((0, 0), (0, 35), (0, -30)),
    *(
        (side * azimuth, elevation)
        for azimuth, elevation in ((35, 15), (35, -25), (70, 5), (90, 30))
        for side in (-1, 1)
    ),
]
POSE = Similarity(1.01, rotation_from_vector(np.array([0.05, -0.1, 0.02])), np.array([4.0, -6.0, 3.0]))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return eleven_cameras().subset(["cam00", "cam02", "cam07", "cam08"])


def eleven_cameras() -> Rig:
    """Cameras of 1024 x 768 at 1.2 m."""
    lens = Intrinsics(1024, 768, 2000.0, 2000.0, 511.5, 383.5)
    cameras = []
    for number, (azimuth, elevation) in enumerate(np.radians(PLACES_DEG)):
        direction = [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        pose = look_at(1200.0 * np.array(direction), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        cameras.append(Camera(f"cam{number:02}", lens, pose))
    return Rig(tuple(cameras))


def face_error(model: HeadModel, coefficients: np.ndarray, truth_world: np.ndarray) -> float:
    face = model.levels["full"].face_region
    return float(np.linalg.norm(POSE.apply(model.vertices(coefficients))[face] - truth_world[face], axis=1).mean())


def views(model: HeadModel, rig: Rig, renderer: Renderer, z: np.ndarray) -> dict[str, Silhouette]:
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        return {n: silhouette_from_mask(m) for n, m in drawn.masks(POSE.apply(model.vertices(z))).items()}


def test_unweighted_it_counts_the_pixels_that_differ_as_eq_4(model: HeadModel, rig: Rig, renderer: Renderer) -> None:
    rng = np.random.default_rng(1)
    seen, z = views(model, rig, renderer, rng.standard_normal(10)), 0.5 * rng.standard_normal(10)
    with SilhouetteObjective(
        model, POSE, seen, rig, renderer=renderer, level="p99", scale=0.25, start=z, speaking="all", weighted=False
    ) as objective:
        cost = objective(z)
    with renderer.silhouette_set(rig, model.levels["p99"].faces, 0.25) as drawn:
        masks = drawn.masks(POSE.apply(model.vertices(z, "p99")))
    wanted = {name: mask_at_scale(seen[name].distance, 0.25) for name in masks}
    assert cost == sum(int((wanted[name] != mask).sum()) for name, mask in masks.items())
    assert cost > 100.0


def test_a_lid_over_the_neck_changes_no_pixel_that_may_speak(model: HeadModel, rig: Rig, renderer: Renderer) -> None:
    """Eq. 5 from every triangle of the open mesh, by an independent rasteriser."""
    rng = np.random.default_rng(2)
    seen, z = views(model, rig, renderer, rng.standard_normal(10)), 0.5 * rng.standard_normal(10)
    with SilhouetteObjective(
        model, POSE, seen, rig, renderer=renderer, level="p99", scale=0.25, start=np.zeros(10)
    ) as objective:
        cost = objective(z)
    level, expected = model.levels["p99"], 0.0
    start, vertices = (POSE.apply(model.vertices(c, "p99")) for c in (np.zeros(10), z))
    for camera in rig.scaled(0.25):
        observed = mask_at_scale(seen[camera.name].distance, 0.25)
        open_start, drawn = (np.isfinite(camera_depth(camera, v, level.faces)) for v in (start, vertices))
        named = camera.project(POSE.apply(model.vertices(np.zeros(10))))
        speaks = face_pixels(open_start, named, model.levels["full"].face_region)
        expected += boundary_weighted_xor(observed, drawn, boundary_weights(observed) * speaks)
    # A pixel whose centre lies on an edge (1 in 10^4) may go either way: of 1,500 contour pixels, a few of cost 1.
    assert cost == pytest.approx(expected, abs=3.0)
    assert cost > 50.0


def test_a_lid_closes_holes_outside_the_face_alone(model: HeadModel) -> None:
    level = model.levels["p99"]
    shut = close_holes(level.faces, level.face_region)
    assert is_closed(shut)
    assert not is_closed(level.faces)
    np.testing.assert_array_equal(shut[: len(level.faces)], level.faces)
    assert close_holes(level.faces, np.ones(level.count, bool)) is level.faces


def test_every_hole_gets_its_lid() -> None:
    """A prism of five sides, open at both ends."""
    low, high = np.arange(5), np.arange(5, 10)
    after = np.roll(low, -1)
    walls = np.concatenate([np.stack([low, after, high], 1), np.stack([after, after + 5, high], 1)])
    shut = close_holes(walls, np.zeros(10, bool))
    assert is_closed(shut)
    assert len(shut) == len(walls) + 2 * 3
    assert shut.dtype == walls.dtype
    only_above = np.arange(10) >= 5
    assert close_holes(walls, only_above) is walls


def test_a_contour_through_pixels_centres_falls_as_a_chessboard_and_a_larger_pixel_averages_all_it_covers() -> None:
    rows, columns = np.mgrid[:6, :8]
    np.testing.assert_array_equal(mask_at_scale(np.zeros((6, 8), np.float32), 1.0), (rows + columns) % 2 == 1)
    distance = np.ones((8, 8), np.float32)
    distance[0, 0] = -100.0
    np.testing.assert_array_equal(mask_at_scale(distance, 0.25), [[True, False], [False, False]])


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.25])
def test_a_smaller_mask_has_the_same_contour(scale: float) -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:120, :160]
    errors = []
    for _ in range(60):
        radius, place = rng.uniform(30.0, 40.0), rng.uniform(-2.0, 2.0, 2) + (60.0, 80.0)
        small = mask_at_scale(signed_distance(np.hypot(rows - place[0], columns - place[1]) < radius), scale)
        assert small.shape == (120 * scale, 160 * scale)
        centre = (np.argwhere(small).mean(axis=0) + 0.5) / scale - 0.5  # pixel centres move as in Intrinsics.scaled
        errors.append([np.sqrt(small.sum() / scale**2 / np.pi) - radius, *(centre - place)])
    # Radius (of equal area) and centre; the blur in the distance shifts a bend inwards by 1 / (2 r) = 0.014 px, and the
    # mean of 60 draws at a quarter of the size has a standard error of 0.02 px.
    assert np.abs(np.mean(errors, axis=0)).max() < 0.014 + 2 * 0.02


def test_pixels_belong_to_the_nearest_stretch_of_the_outline() -> None:
    mask = np.zeros((60, 80), bool)
    mask[10:50, 20:60] = True
    # the left edge is face, the right edge is not; a vertex inside the outline has no say
    pixels = np.array(
        [[20.0, y] for y in range(10, 50)] + [[59.0, y] for y in range(10, 50)] + [[55.0, 30.0], [-9.0, 5.0]]
    )
    region = np.array([True] * 40 + [False] * 40 + [True, True])
    speaks = face_pixels(mask, pixels, region)
    assert speaks[10:50, :38].all()
    assert not speaks[10:50, 42:].any()


def outlined(*vertices: tuple[float, float, bool]) -> np.ndarray:
    """What may speak of a mask that reaches from the left edge of the picture to its right one."""
    mask = np.zeros((60, 80), bool)
    mask[10:50] = True
    pixels = np.array([(column, row) for column, row, _ in vertices])
    return face_pixels(mask, pixels, np.array([face for _, _, face in vertices]))


def test_vertices_outside_the_picture_have_no_say_and_those_on_its_edge_have() -> None:
    """The face is at the first column, and what lies beyond the picture would name the last one."""
    beyond = [(-1.0, 10.0, True), (80.0, 10.0, True), (40.0, -1.0, True), (40.0, 60.0, True), (np.nan, np.nan, True)]
    speaks = outlined((0.0, 10.0, True), (79.0, 10.0, False), *beyond)
    assert speaks[:, :39].all()
    assert not speaks[:, 41:].any()
    mask = np.zeros((60, 80), bool)
    mask[:, 20:] = True
    assert face_pixels(mask, np.array([[20.0, 0.0]]), np.array([True])).all()


def test_a_stretch_belongs_to_the_face_where_most_of_its_vertices_do_and_to_nobody_without_any() -> None:
    face, other = (40.0, 10.0, True), (40.0, 10.0, False)
    assert outlined(face, face, other).all()
    assert not outlined(face, other).any()
    assert not outlined(face, other, other).any()
    speaks = outlined((40.0, 30.0, True))
    assert (speaks.shape, speaks.dtype, speaks.any()) == ((60, 80), bool, False)


def test_what_the_model_cannot_make_has_no_pull(model: HeadModel, rig: Rig, renderer: Renderer) -> None:
    """Shoulders below the neck and a bun on the skull change nothing; a bump on the nose does."""
    nothing = np.zeros(10)
    bare = views(model, rig, renderer, nothing)
    vertices = POSE.apply(model.vertices(nothing))
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    back = np.array([0.0, high + 15.0, vertices[:, 2].mean() - 60.0])
    slopes = {}
    for name, lump in {"shoulders": np.array([0.0, low - 20.0, 0.0]), "bun": back, "nose": None}.items():
        cluttered = {}
        for camera in rig:
            place = vertices[model.landmarks["pronasale"]] if lump is None else lump
            column, row = camera.project(place[None])[0]
            rows, columns = np.mgrid[: camera.intrinsics.height, : camera.intrinsics.width]
            width, height = (20, 20) if lump is None else (150, 40) if name == "shoulders" else (50, 50)
            blob = (np.abs(rows - row) < height) & (np.abs(columns - column) < width)
            cluttered[camera.name] = silhouette_from_mask(bare[camera.name].mask | blob)
        costs = []
        for seen in (bare, cluttered):
            with SilhouetteObjective(
                model, POSE, seen, rig, renderer=renderer, level="p99", scale=0.25, start=nothing
            ) as objective:
                costs.append([objective(sign * 2.0 * np.eye(10)[0]) for sign in (-1, 1)])
        # what the clutter adds to the difference between a much smaller and a much larger head
        slopes[name] = abs((costs[1][1] - costs[1][0]) - (costs[0][1] - costs[0][0])) / abs(costs[0][1] + costs[0][0])
    assert slopes["shoulders"] < 0.02
    assert slopes["bun"] < 0.02
    assert slopes["nose"] > 0.02


def test_a_fit_reports_uses_what_is_usable_and_may_be_cancelled(model: HeadModel, rig: Rig, renderer: Renderer) -> None:
    seen = views(model, rig, renderer, np.array([1.0, -1.0]))
    seen["cam02"] = Silhouette(seen["cam02"].mask, seen["cam02"].distance, ViewQuality(usable=False))
    fractions: list[float] = []
    settings = FittingSettings(modes=2)
    fit = fit_simplex(model, POSE, seen, rig, settings, renderer=renderer, report=lambda stage, f: fractions.append(f))
    assert fractions == sorted(fractions)
    assert fractions[-1] <= 1.0
    assert fit.used == {"cam00": True, "cam02": False, "cam07": True, "cam08": True}
    assert fit.termination_reason.count("converged") == len(HIERARCHY)
    assert fit.evaluations < len(HIERARCHY) * LIMIT
    assert fit.world_from_head is POSE
    # Two modes of some millimetres against masks of 1.2 mm a pixel: a tenth of a standard deviation is seen.
    np.testing.assert_allclose(fit.coefficients, [1.0, -1.0], atol=0.15)

    def cancel(stage: str, fraction: float) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        fit_simplex(model, POSE, seen, rig, settings, renderer=renderer, report=cancel)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_simplex_takes_half_of_the_mean_head_s_error(model: HeadModel, renderer: Renderer) -> None:
    """One planted head, all sixty modes; tests/laboratory/notes/paper.md has the mean over ten."""
    rig = eleven_cameras()
    truth = np.clip(np.random.default_rng(0).standard_normal(60), -0.8, 0.8)
    vertices = POSE.apply(model.vertices(truth))
    seen = views(model, rig, renderer, truth)
    fit = fit_simplex(model, POSE, seen, rig, FittingSettings(), renderer=renderer, report=lambda stage, f: None)
    before = face_error(model, np.zeros(60), vertices)
    assert face_error(model, fit.coefficients, vertices) < 0.5 * before
