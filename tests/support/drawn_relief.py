"""Draws a relief of skin at random."""

import numpy as np
from jaxtyping import Float

from rig.studio.scene.skin_texture import LONGEST_MM, SHORTEST_MM, WAVES, SkinRelief


def draw_relief(
    rng: np.random.Generator, centres: Float[np.ndarray, "c 3"], radius_mm: float, slope: float
) -> SkinRelief:
    """Draws a relief of waves in all directions with equal power in each octave of slope. ``slope`` is its root mean
    square."""
    directions = rng.standard_normal((WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths_mm = np.exp(rng.uniform(np.log(SHORTEST_MM), np.log(LONGEST_MM), WAVES))
    amplitudes_mm = slope * np.sqrt(3.0 / WAVES) * lengths_mm / (2 * np.pi)  # two thirds of a wave's slope is seen
    vectors = directions * (2 * np.pi / lengths_mm)[:, None]
    return SkinRelief(vectors, rng.uniform(0, 2 * np.pi, WAVES), amplitudes_mm, centres, radius_mm)
