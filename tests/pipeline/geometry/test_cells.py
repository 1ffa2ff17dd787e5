"""Points in cells: everything within a cell's width of a point lies in the 27 cells about its own."""

import numpy as np

from pipeline.geometry.nearest import sorted_into_cells

WIDE = 2.0


def test_near_points_are_at_fixed_steps_of_the_key() -> None:
    points = np.random.default_rng(0).uniform(-9.0, 7.0, (400, 3))
    cells = sorted_into_cells(points, WIDE)
    key_of = np.empty(len(points), np.int64)
    key_of[cells.order] = cells.keys
    steps = {(i * cells.spans[1] + j) * cells.spans[2] + k for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    for a, b in np.argwhere(apart < WIDE):
        assert key_of[b] - key_of[a] in steps


def test_keys_are_sorted_and_the_outermost_cells_are_empty() -> None:
    cells = sorted_into_cells(np.random.default_rng(1).normal(size=(50, 3)), 0.7)
    assert (np.diff(cells.keys) >= 0).all()
    index = np.stack(np.unravel_index(cells.keys, cells.spans))
    assert (index >= 1).all()
    assert (index < cells.spans[:, None] - 1).all()
