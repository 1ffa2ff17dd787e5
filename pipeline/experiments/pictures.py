"""The paper's figures 4 and 5 of one's own results: heads side by side, and silhouette differences before and after."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.imaging.cpu_raster import picture
from pipeline.results.overlays import PAPER, ImageRgb, contact_sheet, difference
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.mesh import Mesh

SKIN = np.array([214.0, 188.0, 168.0])
LAMP = np.array([-0.35, 0.45, 0.82])  # head frame
AZIMUTH_DEG, PANEL = 30.0, (360, 480)
GREY = 200

Masks = Mapping[str, Bool[np.ndarray, "h w"]]


def heads(rows: Sequence[Sequence[tuple[str, Mesh]]]) -> ImageRgb:
    """Figure 4: shaded heads (head frame) in rows, seen from the subject's left front."""
    return np.vstack([np.hstack([_labelled(shaded(mesh), text) for text, mesh in row]) for row in rows])


def differences(rows: Sequence[tuple[str, Masks, Masks]], cameras: Sequence[str]) -> ImageRgb:
    """Figure 5: for each row (text, input masks, model masks) what differs in some cameras, and how many pixels."""
    drawn = []
    for text, observed, model in rows:
        panels = []
        for name in cameras:
            count = int((observed[name] ^ model[name]).sum())
            blank = np.full((*observed[name].shape, 3), GREY, np.uint8)
            panels.append((f"{text}, {name}: {count} px", difference(blank, observed[name], model[name])))
        drawn.append(panels)
    return contact_sheet(drawn)


def shaded(mesh: Mesh) -> ImageRgb:
    """One head, lit from its right front, twice supersampled."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    width, height = 2 * PANEL[0], 2 * PANEL[1]
    azimuth, distance = np.radians(AZIMUTH_DEG), 6.0 * radius
    eye = centre + distance * np.array([np.sin(azimuth), 0.05, np.cos(azimuth)])
    focal = 0.5 * min(width * 1.25, height) * distance / (0.85 * radius)
    lens = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    camera = Camera("figure", lens, look_at(eye, centre, np.array([0.0, 1.0, 0.0])))
    drawn = picture(camera, mesh.vertices, mesh.faces, _lit(mesh), PAPER)
    return cv2.resize(drawn, PANEL, interpolation=cv2.INTER_AREA)


def _lit(mesh: Mesh) -> UInt8[np.ndarray, "v 3"]:
    cosine: Float[np.ndarray, " v"] = np.clip(mesh.normals() @ (LAMP / np.linalg.norm(LAMP)), 0.0, 1.0)
    return np.clip(SKIN * (0.25 + 0.75 * cosine[:, None]), 0, 255).astype(np.uint8)


def _labelled(image: ImageRgb, text: str) -> ImageRgb:
    out = image.copy()
    cv2.putText(out, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return out
