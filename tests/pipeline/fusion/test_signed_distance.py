"""What the guess beyond the photographs loses: horns, and nothing that is thick or lies beside what is seen."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.fusion.grid import Grid, whole_box
from pipeline.fusion.signed_distance import (
    AWAY_MM,
    HORN_MM,
    REACH,
    Votes,
    excluded_by_outlines,
    votes_at,
    votes_in_box,
    without_horns,
)
from pipeline.fusion.view_stack import stack_views
from tests.support.ellipsoid_depths import Ellipsoid, scene
from tests.support.scenes import fan

STEP_MM, BODY_MM = 6.0, 60.0
HORN_WIDE_MM = 12.0


def body_with_horn() -> tuple[Grid, np.ndarray, np.ndarray]:
    """A ball, a thin horn that stands on it towards +y, and which nodes the horn alone holds."""
    grid = whole_box(np.full(3, -100.0), np.array([200.0, 260.0, 200.0]), STEP_MM)
    places = grid.corner + grid.step_mm * grid.index
    ball = np.linalg.norm(places, axis=1) - BODY_MM
    horn = np.maximum(np.hypot(places[:, 0], places[:, 2]) - HORN_WIDE_MM, np.abs(places[:, 1] - 60.0) - 60.0)
    return grid, np.minimum(ball, horn), (horn < 0) & (ball > HORN_MM / 3)


def votes_on(grid: Grid, seen: np.ndarray) -> Votes:
    nothing = np.zeros(len(grid), np.float32)
    return Votes(nothing, np.where(seen, 1.0, 0.0).astype(np.float32), nothing)


def test_a_horn_that_nobody_sees_goes_and_the_body_stays() -> None:
    grid, guess, horn = body_with_horn()
    left = without_horns(guess, votes_on(grid, np.zeros(len(grid), bool)), grid)
    assert horn.sum() > 20
    assert (left[horn] > 0).all()
    body = guess < -STEP_MM
    assert (left[body & ~horn & (np.linalg.norm(grid.corner + STEP_MM * grid.index, axis=1) < BODY_MM)] < 0).all()


def test_what_is_thin_beside_what_is_seen_stays() -> None:
    grid, guess, horn = body_with_horn()
    left = without_horns(guess, votes_on(grid, horn), grid)
    assert left[horn] == pytest.approx(guess[horn])


def test_only_what_lies_away_from_the_seen_is_judged() -> None:
    grid, guess, horn = body_with_horn()
    places = grid.corner + grid.step_mm * grid.index
    top = horn & (places[:, 1] > 110.0)
    left = without_horns(guess, votes_on(grid, top), grid)
    near = horn & (places[:, 1] > 110.0 - AWAY_MM + STEP_MM)
    assert (left[near] < 0).all()
    far = horn & (places[:, 1] < 110.0 - AWAY_MM - STEP_MM)
    assert (left[far] > 0).all()


def test_blocks_outside_two_outlines_are_what_every_node_says_for_itself() -> None:
    """A distorting lens and a ball in a box of 500 mm: what is decided at once is most of it, and the same."""
    made = scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(400, 300))
    views = stack_views(made.maps, made.silhouettes, made.rig)
    box = whole_box(np.full(3, -250.0), np.full(3, 500.0), STEP_MM)
    at_once, alone = votes_in_box(box, views), votes_at(box, views)
    excluded = excluded_by_outlines(box, views, REACH * STEP_MM)
    assert excluded.mean() > 0.7 * (alone.bound == np.float32(REACH * STEP_MM)).mean() > 0.4
    for name in ("value", "weight", "bound"):
        assert np.array_equal(getattr(at_once, name), getattr(alone, name))


def test_a_view_with_a_silenced_outline_excludes_no_block() -> None:
    made = scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(400, 300))
    views = stack_views(made.maps, made.silhouettes, made.rig)
    box = whole_box(np.full(3, -250.0), np.full(3, 500.0), 2 * STEP_MM)
    only = np.arange(len(made.maps)) == 0
    assert not excluded_by_outlines(box, replace(views, steady=only), REACH * STEP_MM).any()
