"""Computes surface nets: a mesh of the zero level of a scalar field on the nodes of a grid.

The method is the naive version of Gibson, *Constrained elastic surface nets*, 1998: every cell with corners of both
signs gets a vertex at the mean of its edges' zero crossings, and every edge with both signs gets a quadrilateral. The
input is a field, negative inside, at the nodes of a sparse grid; it must be positive on the outermost nodes. The output
is vertices in units of the grid step, and triangles that face outwards. The mesh is closed; it is a manifold if the
field's signs are well composed (``pipeline.fusion.grid_kernels``)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from pipeline.geometry.surface_nets_kernels import linked, net_faces, net_vertices


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceNet:
    """Holds a mesh in units of the grid step. ``of_cell`` holds, for each node, the vertex in the cell whose lowest
    corner is this node; -1 if the cell has no vertex."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    of_cell: Int32[np.ndarray, " n"]


def node_keys(index: Int32[np.ndarray, "n 3"], shape: tuple[int, int, int]) -> Int64[np.ndarray, " n"]:
    """Returns the number of each node in the full grid, counted with the last index fastest."""
    wide = index.astype(np.int64)
    return (wide[:, 0] * shape[1] + wide[:, 1]) * shape[2] + wide[:, 2]


def link_nodes(index: Int32[np.ndarray, "n 3"], shape: tuple[int, int, int]) -> Int32[np.ndarray, "n 6"]:
    """Returns the indices of each node's neighbours in the directions -x +x -y +y -z +z, -1 if there is no neighbour.

    Args:
        index: positions of the nodes in the full grid, in the order of ``node_keys``.
        shape: the number of nodes of the full grid along each axis.
    """
    return linked(index, node_keys(index, shape), shape[1], shape[2])


def surface_net(
    field: Float32[np.ndarray, " n"], index: Int32[np.ndarray, "n 3"], neighbours: Int32[np.ndarray, "n 6"]
) -> SurfaceNet:
    """Builds the mesh of a field's zero level on a sparse grid; each quadrilateral is split along its shorter diagonal.

    Args:
        field: the field's values at the nodes, negative inside.
        index: positions of the nodes in the full grid, in the order of ``node_keys``.
        neighbours: the result of ``link_nodes``; every cell with both signs must be complete.
    """
    vertices, of_cell = net_vertices(field, index, neighbours)
    return SurfaceNet(vertices, net_faces(field, neighbours, vertices, of_cell), of_cell)
