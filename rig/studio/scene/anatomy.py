"""Finds the points of a head from which hair, skin colours and clothes are constructed. Also makes vertex grids."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.mesh import face_normals

Landmarks = Mapping[str, Float[np.ndarray, " 3"]]

PAINTED = (
    "exocanthion_right", "exocanthion_left", "endocanthion_right", "endocanthion_left", "glabella", "pronasale",
    "cheilion_right", "cheilion_left", "labiale_superius", "labiale_inferius", "stomion", "gnathion",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Anatomy:
    """Holds the points (head frame, mm) of a head from which hair, skin colours and clothes are constructed. ``unit``
    is the head's size relative to the head for which the constructions were designed."""

    ears: Float[np.ndarray, " 3"]  # middle between the ears' openings
    half_breadth: float
    chin_y: float
    unit: float
    landmarks: Landmarks  # empty where not all that painting needs are known


def anatomy(vertices: Float[np.ndarray, "v 3"], landmarks: Landmarks) -> Anatomy:
    """Finds the anatomy of a head from its landmarks. Without landmarks, estimates the anatomy from the extent of the
    mesh, scaled from a head of 225 mm from chin to crown."""
    if {"tragion_right", "tragion_left", "gnathion", "glabella"} <= set(landmarks):
        right, left = landmarks["tragion_right"], landmarks["tragion_left"]
        chin = float(landmarks["gnathion"][1])
        unit = float(landmarks["glabella"][1] - chin) / 132.0
        known = landmarks if set(PAINTED) <= set(landmarks) else {}
        return Anatomy((right + left) / 2, float(left[0] - right[0]) / 2, chin, unit, known)
    top = float(np.quantile(vertices[:, 1], 0.9995))
    skull = vertices[vertices[:, 1] > top - 130.0]
    breadth, length = np.ptp(skull[:, 0]), np.ptp(skull[:, 2])
    middle = (skull.min(axis=0) + skull.max(axis=0)) / 2
    ears = np.array([middle[0], top - 130.0, middle[2] - 0.02 * length])
    return Anatomy(ears, 0.46 * float(breadth), top - 225.0, 1.0, {})


def grid_faces(rows: int, columns: int, *, closed: bool = True) -> Int[np.ndarray, "f 3"]:
    """Returns the triangles of a grid of vertices, which are numbered row by row. If ``closed``, triangles join the
    last column to the first."""
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(columns - (not closed)), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = a + columns, b + columns
    return np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])


def turned_along(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], outward: Float[np.ndarray, "v 3"]
) -> Int[np.ndarray, "f 3"]:
    """Reverses all triangles if their normals point against ``outward``, the outward directions at the vertices."""
    along = (face_normals(vertices, faces) * outward[faces[:, 0]]).sum() > 0
    return faces if along else faces[:, ::-1]


def directions_of(elevation: Float[np.ndarray, "r c"], azimuth: Float[np.ndarray, "_ c"]) -> Float[np.ndarray, "r c 3"]:
    """Returns a grid of unit vectors from elevation and azimuth (rad); azimuth is counted from z towards x."""
    ring = np.cos(elevation)
    return np.stack([ring * np.sin(azimuth), np.sin(elevation), ring * np.cos(azimuth)], axis=-1)


def finer_grid(field: Float[np.ndarray, "r c *_"], times: int) -> Float[np.ndarray, "_ _ *_"]:
    """Interpolates a field linearly to a grid that is finer by the factor ``times``. The interpolated field is
    periodic: its last column is next to its first."""
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
