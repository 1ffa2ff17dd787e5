"""Writes the maps of a head's skin: texture/colour.png, texture/normals.png and texture/displacement.png."""

from pathlib import Path

import cv2
import numpy as np

from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.pores.skin_maps import SkinMaps
from rig.atomic_write import write_atomically

PNG_SPEED = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # level 6 takes four times as long for a tenth of the size


def write_skin_maps(folder: Path, atlas: Atlas, maps: SkinMaps) -> None:
    """Writes the maps one after the other, each under a temporary name first. Raises OSError."""
    for name, image in (("colour", atlas.image), ("normals", maps.normals), ("displacement", maps.displacement)):
        stored = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
        write_atomically(folder / f"{name}.png", cv2.imencode(".png", stored, PNG_SPEED)[1].tobytes())
