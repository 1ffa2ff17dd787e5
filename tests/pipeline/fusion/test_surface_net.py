"""Meshes of sign patterns that no surface would have, and crossings beside a plain test of every pair."""

import itertools

import numpy as np
import pytest

from pipeline.fusion.crossings import crossing_faces
from pipeline.fusion.grid import Grid, refined, whole_box
from pipeline.fusion.grid_kernels import component_of, compose_well, crossed_at_rim, interpolated
from pipeline.fusion.untangling import CLEAN, mesh_faults, smooth_spots, topology_of
from pipeline.geometry.surface_nets import surface_net
from tests.support.closed_meshes import one_fan_a_vertex


def noise_net(seed: int, count: int = 10) -> tuple[np.ndarray, np.ndarray, Grid, np.ndarray, np.ndarray]:
    """The net of signs drawn at random: every pattern of eight corners occurs, again and again."""
    grid = whole_box(np.zeros(3), np.full(3, count - 1.0), 1.0)
    field = np.random.default_rng(seed).uniform(-1, 1, len(grid)).astype(np.float32)
    field[grid.outer] = 1.0
    compose_well(field, grid.neighbours, grid.outer, 0.01)
    net = surface_net(field, grid.index, grid.neighbours)
    return net.vertices, net.faces, grid, field, net.of_cell


@pytest.mark.parametrize("seed", range(4))
def test_any_pattern_of_signs_gives_a_manifold(seed: int) -> None:
    vertices, faces, *_ = noise_net(seed)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forth, back = edges @ (len(vertices), 1), edges @ (1, len(vertices))
    assert len(np.unique(forth)) == len(forth)  # each edge once either way
    assert np.array_equal(np.sort(forth), np.sort(back))
    assert one_fan_a_vertex(faces, len(vertices))


@pytest.mark.parametrize("seed", range(4))
def test_the_net_stays_inside_its_grid(seed: int) -> None:
    """No sign of an outer node is turned, beyond which there are no cells: a corner would be missing there."""
    vertices, faces, grid, field, _ = noise_net(seed, 6)
    assert np.array_equal(field[grid.outer], np.ones(grid.outer.sum(), np.float32))
    assert not crossed_at_rim(field, grid.neighbours, grid.outer)
    assert 0 <= faces.min() <= faces.max() < len(vertices)


def test_a_surface_that_leaves_its_grid_is_seen() -> None:
    grid = whole_box(np.zeros(3), np.full(3, 5.0), 1.0)
    level = grid.index[:, 0].astype(np.float32) - 2.5
    assert crossed_at_rim(level, grid.neighbours, grid.outer)
    assert not crossed_at_rim(np.where(grid.outer, 1.0, level), grid.neighbours, grid.outer)


def test_volume_of_the_net_is_that_of_the_inner_nodes() -> None:
    """Well composed or not, cells' middles make the cubes about the inner nodes: a cubic step each."""
    _, faces, grid, field, of_cell = noise_net(5)
    cells = np.flatnonzero(of_cell >= 0)
    corners = (grid.index[cells] + 0.5)[faces]
    volume = np.einsum("fx,fx->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx((field < 0).sum())


def test_safe_places_are_clean_and_mend_a_net_that_was_shaken() -> None:
    vertices, faces, grid, _, of_cell = noise_net(2)
    safe, topology = grid.index[of_cell >= 0] + 0.5, topology_of(faces, len(vertices))
    assert mesh_faults(safe, topology) == CLEAN
    shaken = vertices + np.random.default_rng(0).normal(0, 0.7, vertices.shape)
    assert mesh_faults(shaken, topology).crossing > 0.1 * len(faces)
    assert mesh_faults(smooth_spots(shaken, topology, safe), topology) == CLEAN


def test_crossings_are_those_of_every_pair_tried() -> None:
    rng = np.random.default_rng(1)
    vertices = rng.uniform(0, 1, (60, 1, 3)) * 1.5 + rng.uniform(-0.5, 0.5, (60, 3, 3))
    faces = np.arange(180).reshape(60, 3)
    expected = np.zeros(60, bool)
    for f, g in itertools.combinations(range(60), 2):
        if meet(vertices[f], vertices[g]) or meet(vertices[g], vertices[f]):
            expected[[f, g]] = True
    assert 10 < expected.sum() < 60
    assert np.array_equal(crossing_faces(vertices.reshape(-1, 3), faces), expected)


def meet(one: np.ndarray, other: np.ndarray) -> bool:
    """Does an edge of one triangle go through the other? Solves for the point."""
    for k in range(3):
        start, along = one[k], one[(k + 1) % 3] - one[k]
        system = np.stack([other[1] - other[0], other[2] - other[0], -along], axis=1)
        a, b, t = np.linalg.solve(system, start - other[0])
        if a > 0 and b > 0 and a + b < 1 and 0 < t < 1:
            return True
    return False


def test_pieces_are_told_apart() -> None:
    faces = np.array([[0, 1, 2], [4, 3, 5], [5, 6, 4], [2, 1, 7]], np.int32)
    assert component_of(faces, 8).tolist() == [0, 0, 0, 3, 3, 3, 3, 0]


def test_sparse_grid_links_what_a_full_one_links() -> None:
    coarse = whole_box(np.zeros(3), np.array([6.0, 5.0, 4.0]), 1.0)
    wanted = np.random.default_rng(4).random(coarse.shape) < 0.6
    fine = refined(coarse, wanted)
    rows = {tuple(place): row for row, place in enumerate(fine.index.tolist())}
    assert len(rows) == len(fine)
    for row, place in enumerate(fine.index.tolist()):
        assert wanted[tuple(np.array(place) // 2)]
        around = [rows.get(tuple(np.array(place) + offset - 1)) for offset in np.ndindex(3, 3, 3)]
        assert fine.outer[row] == (None in around)
        sides = [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)]
        expected = [rows.get(tuple(np.array(place) + side), -1) for side in sides]
        assert fine.neighbours[row].tolist() == expected


def test_finer_values_are_linear_between_coarse_ones() -> None:
    coarse = whole_box(np.zeros(3), np.array([6.0, 5.0, 4.0]), 1.0)
    box = (coarse.index @ np.array([0.5, -0.25, 2.0])).astype(np.float32).reshape(coarse.shape)
    fine = refined(coarse, np.ones(coarse.shape, bool))
    np.testing.assert_allclose(interpolated(box, fine.index), fine.index / 2 @ np.array([0.5, -0.25, 2.0]), atol=1e-6)
