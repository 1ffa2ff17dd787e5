"""Nets of planted spheres, and of signs drawn at random beside the plain loops."""

import itertools

import numpy as np
import pytest
from jaxtyping import Float, Float32, Int32

from pipeline.geometry.surface_nets import SurfaceNet, link_nodes, surface_net, volume_net
from rig.mesh import boundary_edges


def volume_net_naive(
    field: Float32[np.ndarray, "nx ny nz"],
) -> tuple[Float[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Computes the same mesh as ``volume_net``, in plain Python; the order of the triangles differs."""
    shape, unit = np.array(field.shape), np.eye(3, dtype=int)
    crossings: dict[tuple[int, ...], list[np.ndarray]] = {}
    quads = []
    for axis, node in itertools.product(range(3), np.ndindex(*field.shape)):
        low, high = np.array(node), np.array(node) + unit[axis]
        if (high >= shape).any() or (field[tuple(low)] < 0) == (field[tuple(high)] < 0):
            continue
        start, end = float(field[tuple(low)]), float(field[tuple(high)])
        first, second = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
        cells = [tuple(int(i) for i in low - back) for back in (first + second, second, 0 * first, first)]
        for cell in cells:
            crossings.setdefault(cell, []).append(low + unit[axis] * (start / (start - end)))
        quads.append(cells if start < 0 else [cells[0], cells[3], cells[2], cells[1]])
    rows = {cell: row for row, cell in enumerate(sorted(crossings))}
    vertices = np.array([np.mean(crossings[cell], axis=0) for cell in rows]).reshape(-1, 3)
    faces = [[rows[quad[i]] for i in corners] for quad in quads for corners in ((0, 1, 2), (0, 2, 3))]
    return vertices, np.array(faces, np.int32).reshape(-1, 3)


def random_volume(seed: int, shape: tuple[int, int, int] = (7, 6, 8)) -> np.ndarray:
    """Signs drawn at random, outside at the border: every pattern of eight corners occurs, again and again."""
    field = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    return np.where(inner, field, np.float32(1.0))


def whole(field: np.ndarray) -> SurfaceNet:
    """The sparse grid's net, of a grid that has every node."""
    index = np.argwhere(np.ones(field.shape, bool)).astype(np.int32)
    nx, ny, nz = field.shape
    return surface_net(field.ravel(), index, link_nodes(index, (nx, ny, nz)))


def test_net_of_a_sphere_is_the_sphere() -> None:
    n, radius = 40, 13.3
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1) - 19.7
    vertices, faces = volume_net((np.linalg.norm(grid, axis=-1) - radius).astype(np.float32))
    # A chord of one step on a radius of 13.3 is 1 / (8 r) = 0.01 off, a cell's mean of its crossings a few times that.
    assert np.abs(np.linalg.norm(vertices - 19.7, axis=1) - radius).max() < 0.06
    assert len(boundary_edges(faces)) == 0
    a, b, c = (vertices[faces[:, i]].astype(float) - 19.7 for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6  # positive: wound outwards
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_a_volume_has_the_net_of_the_plain_loops(seed: int) -> None:
    field = random_volume(seed)
    vertices, faces = volume_net(field)
    expected, quads = volume_net_naive(field)
    np.testing.assert_allclose(vertices, expected, atol=1e-5)
    assert sorted(map(tuple, faces)) == sorted(map(tuple, quads))


@pytest.mark.parametrize("seed", range(4))
def test_a_sparse_grid_has_the_same_net_but_for_its_diagonals(seed: int) -> None:
    field = random_volume(seed)
    net, (vertices, faces) = whole(field), volume_net(field)
    np.testing.assert_array_equal(net.vertices.astype(np.float32), vertices)
    quads, plain = (np.sort(np.concatenate([half[0::2], half[1::2]], axis=1), axis=1) for half in (net.faces, faces))
    np.testing.assert_array_equal([np.unique(quad) for quad in quads], [np.unique(quad) for quad in plain])
    lengths = [
        np.linalg.norm(net.vertices[triangles[0::2, 0]] - net.vertices[triangles[0::2, 2]], axis=1)
        for triangles in (net.faces, faces)
    ]
    assert (lengths[0] <= lengths[1]).all()
    assert (lengths[0] < lengths[1]).any()


def test_a_net_that_reaches_the_border_is_closed_there() -> None:
    """At the low sides of the box it was open."""
    field = np.full((6, 5, 7), -1.0, np.float32)
    for axis in range(3):
        np.moveaxis(field, axis, 0)[[0, -1]] = 1.0
    vertices, faces = volume_net(field)
    assert len(boundary_edges(faces)) == 0
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6  # positive: wound outwards
    # The box of inner nodes, 3 by 2 by 4 steps, and half a step to all sides but at its edges.
    assert 3 * 2 * 4 < volume < 4 * 3 * 5


def test_a_volume_without_inside_has_no_net() -> None:
    vertices, faces = volume_net(np.ones((4, 4, 4), np.float32))
    assert (len(vertices), len(faces)) == (0, 0)
