"""Makes curls: ridges that wind over a surface of hair, with dark valleys between them."""

import numpy as np
from jaxtyping import Float

from rig.studio.sensor.noise import waves

Vertices = Float[np.ndarray, "v 3"]

RIDGE_SHARE = 0.5  # how high curls stand, against the distance from one to the next
VALLEY = 0.45  # tone between curls, where little light falls


def curled(
    vertices: Vertices, normals: Vertices, curl_mm: float, amount: Float[np.ndarray, " v"], rng: np.random.Generator
) -> tuple[Vertices, Float[np.ndarray, " v"]]:
    """Raises curls on a surface of hair. Returns the new vertices, and a shade for each, relative to the hair's tone. A
    ridge winds along where a random field is near zero.

    Args:
        vertices: of the smooth surface (mm), a few to each curl.
        normals: unit, outward.
        curl_mm: distance from curl to curl.
        amount: 0 (none) to 1, for each vertex.
        rng: draws the ridges.
    """
    swirl = waves(rng, vertices, 1.6 * curl_mm, 2.6 * curl_mm)
    ridge = np.exp(-((swirl / 0.5) ** 2))
    tuft = 0.3 * waves(rng, vertices, 3.0 * curl_mm, 6.0 * curl_mm)
    height = amount * curl_mm * RIDGE_SHARE * (1.4 * ridge - 0.7 + tuft)
    shade = 1.0 + amount * (VALLEY + (1.15 - VALLEY) * ridge - 1.0)
    return vertices + height[:, None] * normals, shade
