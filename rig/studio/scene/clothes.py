"""Makes shoulders in a shirt, for a head whose mesh ends at the neck."""

import cv2
import numpy as np
from jaxtyping import Float, Int

from rig.mesh import Mesh, boundary_edges, face_normals
from rig.studio.scene.anatomy import Anatomy, grid_faces
from rig.studio.sensor.sensor import around

COLUMNS = 120
# Rings from the collar down: drop below the collar, half width, half depth (mm); the first two follow the neck.
RINGS = (
    (0, 0, 0),
    (14, 0, 0),
    (34, 112, 78),
    (52, 150, 90),
    (76, 183, 100),
    (110, 205, 110),
    (170, 214, 118),
    (330, 216, 122),
)
BUST_MM = 95.0  # a mesh that reaches this far below the collar brings its own shoulders


def shirt(
    head: Mesh, body: Anatomy, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "s 3"], Int[np.ndarray, "f 3"]] | None:
    """Makes a shirt for a head whose mesh ends at the neck: vertices (head frame, mm) and outward faces. Returns None
    for a bust, which has shoulders."""
    vertices = head.vertices
    collar_y = body.chin_y - 27.0 * body.unit
    if vertices[:, 1].min() < collar_y - BUST_MM or vertices[:, 1].min() > collar_y:
        return None
    rim = vertices[np.unique(boundary_edges(head.faces))]
    rim = rim[rim[:, 1] < body.chin_y]
    if len(rim):  # the cut through the neck must not show
        collar_y = min(max(collar_y, float(rim[:, 1].max()) + 7.0), body.chin_y - 12.0)
    neck = vertices[np.abs(vertices[:, 1] - collar_y) < 8.0]
    axis = (neck.min(axis=0) + neck.max(axis=0)) / 2
    rings = _rings(vertices, collar_y, axis)
    grid = _denser(rings)
    folds = 2.2 * around(rng, len(grid), COLUMNS, 9, 16) + 0.8 * around(rng, len(grid), COLUMNS, 18, 40)
    out = (grid - axis) * (1, 0, 1)
    out /= np.linalg.norm(out, axis=2, keepdims=True)
    grid = grid + out * (folds * np.clip(np.linspace(-0.3, 1, len(grid)), 0.0, 1)[:, None])[:, :, None]
    points = grid.reshape(-1, 3)
    faces = grid_faces(len(grid), COLUMNS)
    outward = (face_normals(points, faces) * out.reshape(-1, 3)[faces[:, 0]]).sum()
    return points, faces if outward > 0 else faces[:, ::-1]


def _rings(
    vertices: Float[np.ndarray, "v 3"], collar_y: float, axis: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "r c 3"]:
    """Returns outlines from the collar down; each encloses the neck at its height and the ring above."""
    angle = np.arange(COLUMNS) * 2 * np.pi / COLUMNS
    across, ahead = np.sin(angle), np.cos(angle)
    rings, reach = [], np.zeros(COLUMNS)
    for drop, half_width, half_depth in RINGS:
        reach = np.maximum(reach, _neck(vertices, collar_y - drop, axis))
        if half_width:
            planned = ((np.abs(across) / half_width) ** 2.5 + (np.abs(ahead) / half_depth) ** 2.5) ** (-1 / 2.5)
            reach = np.maximum(reach, planned)
        y = collar_y - drop - 9.0 * np.maximum(ahead, 0) * (drop < 20)  # the neckline is lower in front
        rings.append(np.stack([axis[0] + reach * across, y, axis[2] + reach * ahead], axis=1))
    return np.array(rings)


def _neck(vertices: Float[np.ndarray, "v 3"], y: float, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " c"]:
    """Returns the radius around the axis by angle, with room for the cloth; 0 below the mesh."""
    near = vertices[np.abs(vertices[:, 1] - y) < 9.0] - axis
    radius = np.zeros(COLUMNS, np.float32)
    if len(near) < 20:
        return radius.astype(float)
    column = np.rint(np.arctan2(near[:, 0], near[:, 2]) / (2 * np.pi) * COLUMNS).astype(int) % COLUMNS
    np.maximum.at(radius, column, np.hypot(near[:, 0], near[:, 2]))
    wrapped = np.tile(radius, 3)[None]
    wrapped = cv2.GaussianBlur(cv2.dilate(wrapped, np.ones((1, 9), np.uint8)), (0, 0), 2.0)
    return wrapped[0, COLUMNS : 2 * COLUMNS] + 3.0


def _denser(rings: Float[np.ndarray, "r c 3"]) -> Float[np.ndarray, "n c 3"]:
    at = np.linspace(0, len(rings) - 1, 8 * len(rings))
    flat = rings.reshape(len(rings), -1)
    smooth = np.stack([np.interp(at, np.arange(len(rings)), column) for column in flat.T], axis=1)
    kernel = np.array([1, 2, 3, 2, 1]) / 9.0
    padded = np.concatenate([2 * smooth[:1] - smooth[2:0:-1], smooth, 2 * smooth[-1:] - smooth[-2:-4:-1]])
    blurred = sum(kernel[i] * padded[i : i + len(smooth)] for i in range(5))
    return np.asarray(blurred).reshape(len(at), -1, 3)
