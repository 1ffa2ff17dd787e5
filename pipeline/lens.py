"""The lens for compiled loops: one packing, one projection. ``rig.camera`` is the reference that tests hold it to."""

import numpy as np
from jaxtyping import Float
from numba import njit

from rig.camera import Camera

RADIUS_MOST = 1e6  # instead of an endless turning radius, which compiled loops with fast arithmetic may not meet
NOWHERE = 1e9  # a pixel outside of every image


def packed_lens(camera: Camera) -> Float[np.ndarray, " 10"]:
    """fx fy cx cy k1 k2 p1 p2 k3 and the turning radius."""
    k, d = camera.intrinsics, camera.intrinsics.distortion
    return np.array([k.fx, k.fy, k.cx, k.cy, *d.opencv(), min(d.turning_radius(), RADIUS_MOST)])


@njit(cache=True, nogil=True, fastmath=True)
def distorted(x, y, lens):
    """Pixel (column, row) of the ray (x, y, 1); NOWHERE past the turning radius."""
    r2 = x * x + y * y
    if r2 > lens[9] * lens[9]:
        return NOWHERE, NOWHERE
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return lens[0] * u + lens[2], lens[1] * v + lens[3]
