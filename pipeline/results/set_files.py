"""Writes the textures of texture sets: texture/sets/<set>.png, and of polarised light texture/diffuse and
texture/specular as PNG (sRGB) and OpenEXR (linear, half precision)."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.texturing.chart_colours import CODES, ENCODED
from pipeline.texturing.sets.specular import Specular
from pipeline.texturing.sets.texture_sets import SetTextures
from pipeline.texturing.visibility import LINEAR
from rig.atomic_write import write_atomically
from rig.formats.pictures.exr import write_exr

PNG_SPEED = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # level 6 takes four times as long for a tenth of the size


def write_set_textures(folder: Path, sets: SetTextures) -> None:
    """Writes the textures below ``folder``, each under a temporary name first. Raises OSError."""
    for name, atlas in sets.atlases.items():
        _write_png(folder / "sets" / f"{name}.png", atlas.image)
    if sets.specular is not None and sets.diffuse is not None:
        _write_png(folder / "diffuse.png", sets.diffuse.image)
        write_exr(folder / "diffuse.exr", LINEAR[sets.diffuse.image])
        light = sets.specular.light.astype(np.float32)
        _write_png(folder / "specular.png", _encoded(light))
        write_exr(folder / "specular.exr", light)


def strength_png(specular: Specular) -> bytes:
    """Returns glTF's specular strength as a PNG whose alpha it is; the colours of the pixels are white."""
    alpha = specular.strength()
    return cv2.imencode(".png", cv2.merge([np.full_like(alpha, 255)] * 3 + [alpha]), PNG_SPEED)[1].tobytes()


def _encoded(light: Float[np.ndarray, "s s 3"]) -> UInt8[np.ndarray, "s s 3"]:
    return ENCODED[(CODES * np.clip(light, 0.0, 1.0) + 0.5).astype(np.int32)]


def _write_png(path: Path, image: UInt8[np.ndarray, "s s 3"]) -> None:
    stored = np.ascontiguousarray(image[:, :, ::-1])
    write_atomically(path, cv2.imencode(".png", stored, PNG_SPEED)[1].tobytes())
