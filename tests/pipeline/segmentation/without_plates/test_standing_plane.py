"""A head's points on a table's, and a head's alone."""

import numpy as np

from pipeline.segmentation.without_plates.decide import NEAR, ball_above, standing_plane

CENTRE, RADIUS = np.array([5.0, -3.0, 8.0]), 200.0


def head(rng: np.random.Generator, count: int = 600) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return CENTRE + 70 * points / np.linalg.norm(points, axis=1, keepdims=True)


def table(rng: np.random.Generator, noise_mm: float, count: int = 200) -> np.ndarray:
    """At y = -73, what the head leaves free."""
    flat = rng.uniform(-220, 220, size=(4 * count, 2))
    flat = flat[np.hypot(*flat.T) > 80][:count]
    return CENTRE + np.column_stack([flat[:, 0], -70 + rng.normal(0, noise_mm, count), flat[:, 1]])


def test_a_table_is_found_under_a_head() -> None:
    rng = np.random.default_rng(1)
    points = np.vstack([head(rng), table(rng, 0.5), CENTRE + rng.uniform(-2000, 2000, size=(100, 3))])
    plane = standing_plane(points, CENTRE, RADIUS)
    assert plane is not None
    # 200 points of 0.5 mm over 250 mm: 0.035 mm of height, 0.02 degrees; ten of each.
    assert abs(plane[:3] @ CENTRE + plane[3] - 70) < 0.35
    assert plane[1] > np.cos(np.radians(0.2))


def test_what_stands_on_it_has_the_heads_size() -> None:
    rng = np.random.default_rng(2)
    points = np.vstack([head(rng), table(rng, 0.5)])
    plane = standing_plane(points, CENTRE, RADIUS)
    assert plane is not None
    middle, radius = ball_above(plane, points, CENTRE, RADIUS)
    assert np.linalg.norm(middle - CENTRE) < 2 * NEAR * RADIUS + 5
    assert 70 < radius < 1.25 * 75


def test_a_person_alone_stands_on_nothing() -> None:
    rng = np.random.default_rng(3)
    assert standing_plane(head(rng), CENTRE, RADIUS) is None
    walls = CENTRE + rng.normal(size=(300, 3)) * 150  # a room with things in it everywhere
    assert standing_plane(np.vstack([head(rng), walls]), CENTRE, RADIUS) is None


def test_a_table_through_the_subject_is_none() -> None:
    rng = np.random.default_rng(4)
    half = table(rng, 0.5) + np.array([0.0, 30.0, 0.0])  # 40 mm below the middle: a tenth of the head is under it
    assert standing_plane(np.vstack([head(rng), half]), CENTRE, RADIUS) is None
