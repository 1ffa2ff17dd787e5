"""Makes grids of vertices that are numbered row by row: their triangles, and finer grids."""

import numpy as np
from jaxtyping import Float, Int


def grid_faces(rows: int, columns: int, *, closed: bool = True) -> Int[np.ndarray, "f 3"]:
    """Returns the triangles of a grid of vertices numbered row by row. If ``closed``, the last column is joined to the
    first."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - (not closed)), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def finer_grid(field: Float[np.ndarray, "r c *_"], times: int) -> Float[np.ndarray, "_ _ *_"]:
    """Interpolates a field linearly to a grid ``times`` as fine in both directions. The grid is closed: its first
    column follows its last."""
    if times == 1:
        return field
    rows, columns = field.shape[:2]
    at = np.linspace(0, rows - 1, (rows - 1) * times + 1)
    low = np.minimum(at.astype(int), rows - 2)
    share = (at - low).reshape(-1, *[1] * (field.ndim - 1))
    field = (1 - share) * field[low] + share * field[low + 1]
    at = np.arange(columns * times) / times
    low = at.astype(int)
    share = (at - low).reshape(-1, *[1] * (field.ndim - 2))
    return (1 - share) * field[:, low] + share * field[:, (low + 1) % columns]
