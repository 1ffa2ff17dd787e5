"""Reads outlines.json: outlines of the subject drawn by hand in photographs, as polygons.

``{"format": "eigenhead-outlines/1", "outlines": {"IMG_01": [[[x, y], ...], ...]}}`` lists by camera its polygons, in
pixels; (0, 0) is the centre of the top-left pixel. A pixel inside an even number of polygons is background."""

import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from rig.camera import Camera
from rig.errors import InputError
from rig.messages.message import compose
from rig.rig import Rig

OUTLINES_FORMAT = "eigenhead-outlines/1"
FRACTION_BITS = 4  # corners are rounded to 1/16 pixel for filling


def read_outlines(path: Path, rig: Rig) -> dict[str, Bool[np.ndarray, "_ _"]]:
    """Returns masks (True = subject) of the cameras of ``rig`` that the file has. Raises InputError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["format"] != OUTLINES_FORMAT:
            raise InputError(
                path.name, [compose("format-is", format=f"{document['format']!r:.80}", wanted=f"{OUTLINES_FORMAT!r}")]
            )
        polygons = {
            str(name): [np.asarray(one, float).reshape(-1, 2) for one in drawn]
            for name, drawn in document["outlines"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(path.name, [compose("no-file-read", reason=str(error))]) from error
    faults = [compose("outline-number", camera=n) for n, p in polygons.items() if not _finite(p)]
    if faults:
        raise InputError(path.name, faults)
    return {camera.name: _filled(polygons[camera.name], camera) for camera in rig if camera.name in polygons}


def _finite(polygons: list[np.ndarray]) -> bool:
    return all(np.isfinite(one).all() and (np.abs(one) < 1e5).all() for one in polygons)


def _filled(polygons: list[np.ndarray], camera: Camera) -> Bool[np.ndarray, "h w"]:
    k = camera.intrinsics
    mask = np.zeros((k.height, k.width), np.uint8)
    rounded = [np.rint(one * 2**FRACTION_BITS).astype(np.int32) for one in polygons]
    cv2.fillPoly(mask, rounded, 1, shift=FRACTION_BITS)
    return mask.view(bool)
