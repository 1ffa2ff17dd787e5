"""What is guessed where nobody sees: by the fitted head, by the visual hull, whichever lies nearer to what is seen."""

import numpy as np
import pytest

from pipeline.fusion.grid import whole_box
from pipeline.fusion.prior import SeenSurface, distance_to_subject
from pipeline.fusion.signed_distance import FACTOR, SWEEPS, HeadEars, Votes, at_points, solve_level
from pipeline.fusion.view_stack import stack_views
from rig.mesh import Mesh
from tests.support.ellipsoid_depths import Ellipsoid, scene
from tests.support.scenes import fan
from tests.support.subdivided_spheres import subdivided_sphere

RADIUS_MM = 60.0


def directions(rng: np.random.Generator, count: int, side: float) -> np.ndarray:
    """Unit vectors towards +z (``side`` 1) or -z (-1)."""
    found = rng.standard_normal((count, 3))
    found[:, 2] = side * np.abs(found[:, 2])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def guessed_behind(
    head: Mesh, gap_mm: float, *, behind_mm: float | None = None, strays: int = 0, all_round: bool = True
) -> np.ndarray:
    """The guess at the true places behind a ball that is seen from the front. Outlines leave ``gap_mm`` open, behind
    ``behind_mm``. ``strays`` of the seen points, which count a ninth, lie 8 mm too deep. Cameras stand all round, or
    one before the ball."""
    rng = np.random.default_rng(3)
    front, behind = directions(rng, 4000, 1.0), directions(rng, 500, -1.0)
    points, depth, weight = RADIUS_MM * front, np.full(len(front), gap_mm), np.ones(len(front))
    points[:strays] -= 8.0 * front[:strays]
    depth[:strays] += 8.0
    weight[:strays] = 1.0 / 9.0
    seen = SeenSurface(points, -depth, weight)
    cameras = 1e4 * directions(rng, 300, 1.0) if all_round else np.array([[0.0, 0.0, 1e4]])
    return distance_to_subject(RADIUS_MM * behind, np.full(len(behind), -(behind_mm or gap_mm)), head, seen, cameras)


def ball(radius_mm: float, forward_mm: float) -> Mesh:
    vertices, faces, _ = subdivided_sphere()
    unit = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(radius_mm * unit + (0.0, 0.0, forward_mm), faces)


def test_a_head_that_lies_too_deep_behind_yields_to_a_narrow_hull() -> None:
    """Its back lies 14 mm too deep, its front 2 mm; the outlines leave a millimetre open everywhere."""
    assert np.abs(guessed_behind(ball(52.0, 6.0), 1.0)).mean() < 1.0


def test_a_wide_hull_yields_to_the_head() -> None:
    """The hull alone would be 6 mm off; the head's vertices are up to 5 mm apart."""
    assert np.abs(np.median(guessed_behind(ball(59.0, 0.0), 8.0, behind_mm=14.0))) < 1.5


def test_a_hull_that_fits_where_cameras_see_it_says_nothing_of_the_far_side() -> None:
    """The outline of one camera leaves a millimetre open at the ball's sides, and goes on straight behind it."""
    assert np.abs(np.median(guessed_behind(ball(59.0, 0.0), 1.0, behind_mm=40.0, all_round=False))) < 1.5


def test_chance_matches_of_two_views_hardly_widen_the_gap() -> None:
    """Half of the seen points lie 8 mm too deep: counted whole the guess would be 4 mm too deep."""
    assert np.median(guessed_behind(ball(52.0, 6.0), 1.0, strays=2000)) < 2.0


def test_weak_votes_are_drawn_to_the_guess_and_sure_ones_stay() -> None:
    box = whole_box(np.full(3, -30.0), np.full(3, 60.0), 3.0)
    height = (box.corner + box.step_mm * box.index)[:, 2]
    far, start = np.full(len(box), -4.5, np.float32), height.astype(np.float32)

    def height_of_zero(weight: float) -> float:
        votes = Votes(np.clip(height + 2.0, -4.5, 4.5).astype(np.float32), np.full(len(box), weight, np.float32), far)
        field = solve_level(box, votes, start, SWEEPS, FACTOR).field.reshape(box.shape)
        column = field[5, 5]
        k = int(np.flatnonzero(column > 0)[0])
        return float(box.corner[2] + box.step_mm * (k - column[k] / (column[k] - column[k - 1])))

    assert height_of_zero(0.02) == pytest.approx(0.0, abs=0.3)
    assert height_of_zero(20.0) == pytest.approx(-2.0, abs=0.2)


def test_values_of_a_box_are_read_linearly() -> None:
    box = whole_box(np.full(3, -10.0), np.full(3, 20.0), 4.0)
    places = box.corner + box.step_mm * box.index
    points = np.random.default_rng(0).uniform(-9.0, 5.0, (50, 3))
    assert at_points(box, (places @ (1.0, 2.0, 3.0)).astype(np.float32), points) == pytest.approx(
        points @ (1.0, 2.0, 3.0), abs=1e-4
    )


def test_an_ear_is_laid_towards_its_outlines_and_replaces_fragments_of_depth() -> None:
    """A head of 56 mm has an ear on one side that stands off by 16 mm; pictures show a ball of 60 mm."""
    made = scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(200, 150))
    head = ball(56.0, 0.0)
    ear = head.vertices[:, 0] > 50.0
    standing = Mesh(head.vertices + np.where(ear, 16.0, 0.0)[:, None] * (1.0, 0.0, 0.0), head.faces)
    ears = HeadEars.of(standing, [ear], stack_views(made.maps, made.silhouettes, made.rig))
    assert standing.vertices[ear, 0].max() > 71.0
    assert 70.0 < ears.head_world.vertices[ear, 0].max() < 71.0  # laid flat by a quarter of its 6 mm at most
    assert np.array_equal(ears.head_world.vertices[~ear], standing.vertices[~ear])
    box = whole_box(np.array([30.0, -20.0, -20.0]), np.array([60.0, 40.0, 40.0]), 3.0)
    height = (box.places()[:, 0] - 40.0).astype(np.float32)  # fragments that depth shows 20 mm too deep
    votes = Votes(height, np.full(len(box), 20.0, np.float32), np.full(len(box), -20.0, np.float32))
    level = solve_level(box, *ears.replace_votes(box, votes, height), SWEEPS, FACTOR)
    last = np.flatnonzero(level.field.reshape(box.shape)[:, 6, 6] < 0.0).max()
    assert box.corner[0] + box.step_mm * last == pytest.approx(ears.head_world.vertices[ear, 0].max(), abs=3.1)
