"""Draws the head as the page Result shows it first: a picture of some 30 kB, shown until the browser has loaded and
drawn the 3 MB of the head.

Position, lens and light are those of ``pages/result.js`` and ``static/views.js``: three-quarter view, light "studio",
texture.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.raster import picture
from rig.camera import Camera, Intrinsics
from rig.formats.meshes.ply import read_head_ply
from rig.geometry import look_at
from rig.mesh import Mesh, vertex_normals
from server.console.portrait import placed

SIDE = 720  # pixels, of a picture as wide as high; the view is some 700 high on most screens
FOV_DEG, AWAY = 28.0, 4.25  # of the view; AWAY in radii of the head's sphere
DIRECTION = (0.26, 0.06, 0.96)
AMBIENT = 1.6
LIGHTS = ((0.6, 0.8, 1.2, 1.6), (-1.2, 0.3, 0.7, 0.7), (0.2, 0.9, -1.2, 0.8))  # whence, and how strong
GROUND = (16, 19, 24)  # .view3d in theme.css
GAMMA = 2.2  # near enough to sRGB's curve for a picture that is there for half a second


def first_view(result: Path) -> UInt8[np.ndarray, "s s 3"]:
    """Draws the head of a result as the page Result shows it first (RGB). Raises InputError if the result has no head
    that can be read."""
    head, _ = read_head_ply(result / "head.ply")
    mesh = Mesh(placed(result).apply(head.vertices), head.faces, head.colours)
    return drawn(mesh)


def drawn(mesh: Mesh) -> UInt8[np.ndarray, "s s 3"]:
    """Draws a coloured head (head frame, mm) on the page's background (RGB), at twice the size, and reduces the
    picture, which smooths edges."""
    vertices = mesh.vertices
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    direction = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    eye, size = centre + AWAY * radius * direction, 2 * SIDE
    focal = size / 2 / np.tan(np.radians(FOV_DEG / 2))
    lens = Intrinsics(size, size, focal, focal, (size - 1) / 2, (size - 1) / 2)
    camera = Camera("view", lens, look_at(eye, centre, np.array([0.0, 1.0, 0.0])))
    large = picture(camera, vertices, mesh.faces, lit(mesh), GROUND)
    return np.asarray(cv2.resize(large, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def lit(mesh: Mesh) -> UInt8[np.ndarray, "v 3"]:
    """Computes the vertices' colours in the page's lights, as three.js does for a rough surface: linear colour times
    light over pi."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    light: Float[np.ndarray, " v"] = np.full(len(normals), AMBIENT)
    for *place, power in LIGHTS:
        whence = np.array(place) / np.linalg.norm(place)
        light += power * np.clip(normals @ whence, 0.0, None)
    colours = np.full((len(normals), 3), 255.0) if mesh.colours is None else mesh.colours.astype(float)
    return np.clip(colours * (light[:, None] / np.pi) ** (1.0 / GAMMA), 0.0, 255.0).astype(np.uint8)
