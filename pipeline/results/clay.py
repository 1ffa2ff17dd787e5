"""A head in clay, or in colours of one's own, lit from its right front."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.raster import picture
from pipeline.results.overlays import PAPER, Resized
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.mesh import Mesh

SKIN = np.array([214.0, 188.0, 168.0])
LAMP = np.array([-0.35, 0.45, 0.82])  # head frame
AZIMUTH_DEG, PANEL = 30.0, (360, 480)
DARKEST = 0.25  # of the colour, where no light comes

Box = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]


def clay(
    mesh: Mesh,
    *,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
    azimuth_deg: float = AZIMUTH_DEG,
    panel: tuple[int, int] = PANEL,
    box: Box | None = None,
    paper: tuple[int, int, int] = PAPER,
    darkest: float = DARKEST,
) -> Resized:
    """Draws a mesh (head frame, mm) seen from ``azimuth_deg`` towards its left, twice supersampled; ``panel`` is width
    and height in pixels. ``box``: two corners of what fills the panel, so that several meshes can share a scale."""
    low, high = (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) if box is None else box
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    width, height = 2 * panel[0], 2 * panel[1]
    azimuth, distance = np.radians(azimuth_deg), 6.0 * radius
    eye = centre + distance * np.array([np.sin(azimuth), 0.05, np.cos(azimuth)])
    focal = 0.5 * min(width * 1.25, height) * distance / (0.85 * radius)
    lens = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    camera = Camera("figure", lens, look_at(eye, centre, np.array([0.0, 1.0, 0.0])))
    drawn = picture(camera, mesh.vertices, mesh.faces, lit(mesh, colours, darkest), paper)
    return np.asarray(cv2.resize(drawn, panel, interpolation=cv2.INTER_AREA), np.uint8)


def lit(
    mesh: Mesh, colours: UInt8[np.ndarray, "v 3"] | None = None, darkest: float = DARKEST
) -> UInt8[np.ndarray, "v 3"]:
    """Returns the vertex colours (clay if None) shaded by the lamp."""
    cosine: Float[np.ndarray, " v"] = np.clip(mesh.normals() @ (LAMP / np.linalg.norm(LAMP)), 0.0, 1.0)
    base = SKIN if colours is None else colours.astype(float)
    return np.clip(base * (darkest + (1.0 - darkest) * cosine[:, None]), 0, 255).astype(np.uint8)
