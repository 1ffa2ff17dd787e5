"""Defines a sparse grid of nodes around a surface, which starts as a coarse box and is refined by halving its step.

Nodes are sorted by their keys ``(i * ny + j) * nz + k``. Neighbours have a fixed difference of keys, so a merge of two
sorted lists finds them without a hash table or a full volume.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from pipeline.fusion import grid_kernels as kernels
from pipeline.geometry.surface_nets import link_nodes


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Holds the nodes of a sparse grid; node i lies at ``corner + step_mm * index[i]``, world frame. ``neighbours`` are
    the indices of the nodes towards -x +x -y +y -z +z, -1 if there is none; ``outer`` nodes lack one of their 26
    neighbours."""

    corner: Float[np.ndarray, " 3"]
    step_mm: float
    shape: tuple[int, int, int]
    index: Int32[np.ndarray, "n 3"]
    neighbours: Int32[np.ndarray, "n 6"]
    outer: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.index)

    def places(self, rows: np.ndarray | slice = slice(None)) -> Float[np.ndarray, "m 3"]:
        """Returns the positions of nodes (world frame, mm)."""
        return self.corner + self.step_mm * self.index[rows]


def whole_box(corner: Float[np.ndarray, " 3"], edges_mm: Float[np.ndarray, " 3"], step_mm: float) -> Grid:
    """Returns a grid with all nodes of a box, given its corner, edges and step (mm, world frame)."""
    shape = tuple(int(n) for n in np.ceil(edges_mm / step_mm).astype(int) + 1)
    index = np.stack(np.meshgrid(*(np.arange(n, dtype=np.int32) for n in shape), indexing="ij"), axis=-1)
    return _linked(corner, step_mm, (shape[0], shape[1], shape[2]), index.reshape(-1, 3))


def refined(coarse: Grid, wanted: Bool[np.ndarray, "nx ny nz"]) -> Grid:
    """Returns a grid with half the step of ``coarse``.

    Each marked (``wanted``) node of ``coarse`` becomes eight nodes: one at its position, and seven half a step further
    along x, y and z."""
    nx, ny, nz = coarse.shape
    shape = (2 * nx - 1, 2 * ny - 1, 2 * nz - 1)
    return _linked(coarse.corner, coarse.step_mm / 2, shape, kernels.halved(wanted))


def everywhere(grid: Grid, values: Float32[np.ndarray, " n"], box: Float32[np.ndarray, "_ _ _"]) -> np.ndarray:
    """Returns a dense volume over the grid's box: ``values`` at the grid's nodes, and elsewhere values interpolated
    from ``box``, a volume of twice the step."""
    fine = kernels.doubled(box)
    fine[tuple(grid.index.T)] = values
    return fine


def marked_box(grid: Grid, chosen: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, "nx ny nz"]:
    """Returns a dense volume over the grid's box that is True at the chosen nodes."""
    box = np.zeros(grid.shape, bool)
    box[tuple(grid.index[chosen].T)] = True
    return box


def at_points(box: Grid, values: Float[np.ndarray, " n"], points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
    """Interpolates the values of a dense volume linearly at points."""
    from scipy.ndimage import map_coordinates  # 0.3 s, and only a bust needs it

    at = ((points - box.corner) / box.step_mm).T
    return map_coordinates(values.reshape(box.shape), at, output=np.float64, order=1, mode="nearest")


def _linked(
    corner: Float[np.ndarray, " 3"], step_mm: float, shape: tuple[int, int, int], index: Int32[np.ndarray, "n 3"]
) -> Grid:
    neighbours = link_nodes(index, shape)
    return Grid(corner, step_mm, shape, index, neighbours, kernels.outermost(neighbours))
