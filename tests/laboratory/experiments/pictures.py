"""Draws figures 4 and 5 of the paper from own results: heads side by side, and silhouette differences before and
after."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from pipeline.results.overlays import ImageRgb, clay, contact_sheet, difference
from rig.mesh import Mesh

GREY = 200

Masks = Mapping[str, Bool[np.ndarray, "h w"]]


def heads(rows: Sequence[Sequence[tuple[str, Mesh]]]) -> ImageRgb:
    """Draws figure 4: shaded heads (head frame) in rows, seen from the subject's left front."""
    return np.vstack([np.hstack([labelled(clay(mesh), text) for text, mesh in row]) for row in rows])


def differences(rows: Sequence[tuple[str, Masks, Masks]], cameras: Sequence[str]) -> ImageRgb:
    """Draws figure 5: for each row (text, input masks, model masks) what differs in some cameras, and how many
    pixels."""
    drawn = []
    for text, observed, model in rows:
        panels = []
        for name in cameras:
            count = int((observed[name] ^ model[name]).sum())
            blank = np.full((*observed[name].shape, 3), GREY, np.uint8)
            panels.append((f"{text}, {name}: {count} px", difference(blank, observed[name], model[name])))
        drawn.append(panels)
    return contact_sheet(drawn)


def labelled(image: ImageRgb, text: str) -> ImageRgb:
    """Returns the image with a line of text at its top."""
    out = image.copy()
    cv2.putText(out, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return out
