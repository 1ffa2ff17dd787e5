"""Draws the outlines of a capture's subject, to be laid over its images; runs in a child process."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from rig.atomic_write import write_atomically
from rig.progress import Progress
from server.tasks.child import WorkerContext

WIDTH = 640
COLOUR = (108, 178, 255)  # the accent of the pages
LINE_PX = 3


def draw(context: WorkerContext, report: Progress, *, capture: str, cache: str, target: str) -> None:
    """Draws the subject's outline in each picture of a capture as ``target``/<camera>.png, transparent outside.
    Silhouettes come from the folder ``cache`` or are stored there. Raises InputError."""
    from server.storage.silhouette_cache import segment_once
    from server.tasks.photographs import read_scaled_capture

    shot, rig = read_scaled_capture(Path(capture))
    found = segment_once(Path(cache), shot, rig, report=report)
    for name, silhouette in found.items():
        done, data = cv2.imencode(".png", outline(silhouette.mask)[:, :, [2, 1, 0, 3]])
        assert done
        write_atomically(Path(target) / f"{name}.png", data.tobytes())


def outline(mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "y x 4"]:
    """Draws a mask as an RGBA picture, at most ``WIDTH`` pixels wide: the outline solid, the inside lightly tinted."""
    factor = min(1.0, WIDTH / mask.shape[1])
    size = (round(mask.shape[1] * factor), round(mask.shape[0] * factor))
    small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    alpha = small * np.uint8(26)
    cv2.drawContours(alpha, edges, -1, 255, LINE_PX)
    return np.dstack([np.full(small.shape, value, np.uint8) for value in COLOUR] + [alpha])
