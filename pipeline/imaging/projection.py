"""The lens for compiled loops: one packing, one projection. ``rig.camera`` is the reference that tests hold it to."""

import numpy as np
from jaxtyping import Float

from rig.camera import Camera

RADIUS_MOST = 1e6  # instead of an endless turning radius, which compiled loops with fast arithmetic may not meet


def packed_lens(camera: Camera) -> Float[np.ndarray, " 10"]:
    """fx fy cx cy k1 k2 p1 p2 k3 and the turning radius."""
    k, d = camera.intrinsics, camera.intrinsics.distortion
    return np.array([k.fx, k.fy, k.cx, k.cy, *d.opencv(), min(d.turning_radius(), RADIUS_MOST)])
