"""Paints strips of a texture's layout from photographs, so that no whole image is needed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.texturing.layout.uv_unwrap import Layout
from pipeline.texturing.paint_kernels import Choice, Pictures, paint_rows

EMPTY = 128  # code of texels beside the layout


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Holds a layout's triangles in an image ``size`` texels wide and high, sorted out by rows."""

    layout: Layout
    size: int
    texels: Float[np.ndarray, "n 2"]
    low: Float[np.ndarray, " f"]
    high: Float[np.ndarray, " f"]

    @classmethod
    def of(cls, layout: Layout, size: int, wanted: Bool[np.ndarray, " v"] | None = None) -> "Strips":
        """Places the layout in the image: the triangles with a ``wanted`` vertex, or all."""
        texels = size * layout.uv - 0.5
        rows = texels[layout.faces, 1]
        low, high = rows.min(axis=1), rows.max(axis=1)
        if wanted is not None:
            high[~wanted[layout.source][layout.faces].any(axis=1)] = -np.inf
        return cls(layout, size, texels, low, high)

    def paint(self, first: int, rows: int, pictures: Pictures, choice: Choice) -> UInt8[np.ndarray, "r s 3"]:
        """Paints ``rows`` rows from row ``first`` on (which may be negative): codes, blue first."""
        strip = np.full((rows, self.size, 3), EMPTY, np.uint8)
        which = np.flatnonzero((self.high >= first) & (self.low <= first + rows - 1))
        moved = self.texels - (0.0, float(first))
        paint_rows(strip, 0, rows, which, moved, self.layout.faces, self.layout.source, pictures, choice)
        return strip
