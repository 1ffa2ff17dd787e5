"""Draws a head in clay, or in given colours, lit from its right front."""

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.results.overlays import PAPER, Box, Resized, portrait
from rig.mesh import Mesh

SKIN = np.array([214.0, 188.0, 168.0])
LAMP = np.array([-0.35, 0.45, 0.82])  # head frame
AZIMUTH_DEG, PANEL = 30.0, (360, 480)
DARKEST = 0.25  # of the colour, where no light comes


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
    """Draws a mesh (head frame, mm), supersampled twice.

    ``mesh``: the head. ``colours``: sRGB of its vertices; None draws clay. ``azimuth_deg``: direction from which it is
    seen, 0 = from the front, positive from its left. ``panel``: width and height of the picture, px. ``box``: two
    opposite corners (mm) of what fills the picture, so that several meshes can share a scale; None fits the mesh.
    ``paper``: sRGB of the background. ``darkest``: brightness of surfaces in full shadow.
    """
    fitting = (mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) if box is None else box
    shaded = lit(mesh, colours, darkest)
    return portrait(mesh, shaded, fitting, azimuth_deg, panel, paper=paper, lift=0.05, share=0.85)


def lit(
    mesh: Mesh, colours: UInt8[np.ndarray, "v 3"] | None = None, darkest: float = DARKEST
) -> UInt8[np.ndarray, "v 3"]:
    """Returns the colours of the vertices (clay if None) shaded by the lamp."""
    cosine: Float[np.ndarray, " v"] = np.clip(mesh.normals() @ (LAMP / np.linalg.norm(LAMP)), 0.0, 1.0)
    base = SKIN if colours is None else colours.astype(float)
    return np.clip(base * (darkest + (1.0 - darkest) * cosine[:, None]), 0, 255).astype(np.uint8)
