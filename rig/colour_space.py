"""Converts colours between sRGB and linear light (IEC 61966-2-1), and reads colours from text."""

import re
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

NAMED: Mapping[str, str] = MappingProxyType({
    "black": "#000000", "grey": "#808080", "white": "#ffffff", "red": "#ff0000", "orange": "#ffa500",
    "yellow": "#ffff00", "green": "#008000", "turquoise": "#40e0d0", "blue": "#0000ff", "navy": "#000080",
    "purple": "#800080", "pink": "#ff69b4",
})  # fmt: skip
"""Names of CSS, as far as they are a cap's."""

COLOUR_NAMES = tuple(NAMED)


def srgb_from_text(text: str) -> tuple[float, float, float] | None:
    """Returns the sRGB values (0 to 1) of a colour, ``#rrggbb`` or a name in ``COLOUR_NAMES``; otherwise None."""
    code = NAMED.get(text.strip().lower(), text.strip())
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", code):
        return None
    red, green, blue = (int(code[at : at + 2], 16) / 255.0 for at in (1, 3, 5))
    return red, green, blue


def linear_from_srgb(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Converts sRGB values (0 to 1) to linear values (0 to 1) by IEC 61966-2-1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Converts linear values to sRGB values (0 to 1) by IEC 61966-2-1. Clips linear values to 0 to 1 first."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
