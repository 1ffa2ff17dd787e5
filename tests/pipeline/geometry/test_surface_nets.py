"""Nets of planted spheres, and of signs drawn at random beside the plain loops."""

import itertools

import numpy as np
import pytest
from jaxtyping import Float, Float32, Int32

from pipeline.geometry.surface_nets import SurfaceNet, link_nodes, surface_net
from rig.mesh import boundary_edges


def plain_net(field: Float32[np.ndarray, "nx ny nz"]) -> tuple[Float[np.ndarray, "v 3"], Int32[np.ndarray, "q 4"]]:
    """Computes the vertices of the same net in plain Python, and its quadrilaterals."""
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
    return vertices, np.array([[rows[cell] for cell in quad] for quad in quads], np.int32).reshape(-1, 4)


def random_volume(seed: int, shape: tuple[int, int, int] = (7, 6, 8)) -> np.ndarray:
    """Signs drawn at random, outside at the border: every pattern of eight corners occurs, again and again."""
    field = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    return np.where(inner, field, np.float32(1.0))


def whole(field: np.ndarray) -> SurfaceNet:
    """The net of a grid that has every node."""
    index = np.argwhere(np.ones(field.shape, bool)).astype(np.int32)
    nx, ny, nz = field.shape
    return surface_net(field.ravel(), index, link_nodes(index, (nx, ny, nz)))


def turned(a: int, b: int, c: int) -> tuple[int, ...]:
    """The same triangle, beginning with its lowest corner."""
    return min((a, b, c), (b, c, a), (c, a, b))


def test_net_of_a_sphere_is_the_sphere() -> None:
    n, radius = 40, 13.3
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1) - 19.7
    net = whole((np.linalg.norm(grid, axis=-1) - radius).astype(np.float32))
    vertices, faces = net.vertices, net.faces
    # A chord of one step on a radius of 13.3 is 1 / (8 r) = 0.01 off, a cell's mean of its crossings a few times that.
    assert np.abs(np.linalg.norm(vertices - 19.7, axis=1) - radius).max() < 0.06
    assert len(boundary_edges(faces)) == 0
    a, b, c = (vertices[faces[:, i]] - 19.7 for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6  # positive: wound outwards
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_a_net_is_that_of_the_plain_loops_split_along_shorter_diagonals(seed: int) -> None:
    field = random_volume(seed)
    net, (vertices, quads) = whole(field), plain_net(field)
    np.testing.assert_allclose(net.vertices, vertices, atol=1e-5)
    split = set()
    for a, b, c, d in quads:
        across, along = (np.linalg.norm(vertices[i] - vertices[j]) for i, j in ((a, c), (b, d)))
        split |= {turned(a, b, c), turned(a, c, d)} if across <= along else {turned(b, c, d), turned(b, d, a)}
    assert {turned(*face) for face in net.faces} == split
    assert len(net.faces) == 2 * len(quads)


def test_a_net_that_reaches_the_border_is_closed_there() -> None:
    """At the low sides of the box it was open."""
    field = np.full((6, 5, 7), -1.0, np.float32)
    for axis in range(3):
        np.moveaxis(field, axis, 0)[[0, -1]] = 1.0
    net = whole(field)
    vertices, faces = net.vertices, net.faces
    assert len(boundary_edges(faces)) == 0
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    volume = np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6  # positive: wound outwards
    # The box of inner nodes, 3 by 2 by 4 steps, and half a step to all sides but at its edges.
    assert 3 * 2 * 4 < volume < 4 * 3 * 5


def test_a_volume_without_inside_has_no_net() -> None:
    net = whole(np.ones((4, 4, 4), np.float32))
    assert (len(net.vertices), len(net.faces)) == (0, 0)
