"""Creates rigs of cameras: the default rig of the simulated studio, and rigs with other directions.

Azimuth is counted from the front towards the subject's left, elevation upwards. The world's origin is in the middle of
the head, with y up and z towards the front camera.
"""

from collections.abc import Sequence

import numpy as np

from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig

DISTANCE_MM = 1200.0
WIDTH, HEIGHT = 1024, 768
FOCAL_PX = 2200.0  # a head of 250 mm fills 60 % of the height
LENS_SEED = 2003

DEFAULT_DIRECTIONS_DEG = (
    (0, 0), (0, 38), (0, -36), (-35, 16), (35, 16), (-38, -24), (38, -24), (-65, 4), (65, 4), (-90, 2), (90, 2),
)  # fmt: skip


def default_layout() -> Rig:
    """Returns the default rig: eleven cameras in front of and beside the head, 1.2 m away. cam00 is in front."""
    return rig_from_directions(DEFAULT_DIRECTIONS_DEG)


def rig_from_directions(
    directions_deg: Sequence[tuple[int | float, int | float]],
    seed: int = LENS_SEED,
    *,
    distance_mm: float = DISTANCE_MM,
    rolls_deg: Sequence[float] = (0.0,),
) -> Rig:
    """Returns a rig with a camera in each direction (azimuth and elevation in degrees). Lenses and poses vary slightly.

    Args:
        directions_deg: one for each camera.
        seed: of lenses and mountings.
        distance_mm: from the middle of the head; the focal length keeps the head's size in the picture.
        rolls_deg: rotation of each camera about its optical axis, clockwise seen from behind it; cameras take them in
            turn.
    """
    rng = np.random.default_rng(seed)
    return Rig(
        tuple(
            _camera(f"cam{i:02}", *direction, rng, distance_mm, rolls_deg[i % len(rolls_deg)])
            for i, direction in enumerate(directions_deg)
        )
    )


def _camera(
    name: str, azimuth_deg: float, elevation_deg: float, rng: np.random.Generator, distance_mm: float, roll_deg: float
) -> Camera:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    centre = distance_mm * rng.uniform(0.97, 1.03) * direction + rng.normal(0, 12, 3)
    target = rng.normal(0, 6, 3) + np.array([0.0, 5.0, 0.0])
    tilt = rng.normal(0, 0.02) + np.radians(roll_deg)  # nobody mounts a camera upright to the degree
    up = np.array([np.sin(tilt) * np.cos(azimuth), np.cos(tilt), -np.sin(tilt) * np.sin(azimuth)])
    focal = FOCAL_PX * distance_mm / DISTANCE_MM * rng.uniform(0.97, 1.03)
    lens = Distortion(*(rng.uniform(-1, 1, 4) * (0.08, 0.02, 8e-4, 8e-4)))
    cx, cy = rng.uniform(-12, 12, 2) + np.array([WIDTH - 1, HEIGHT - 1]) / 2
    intrinsics = Intrinsics(WIDTH, HEIGHT, focal, focal * rng.uniform(0.999, 1.001), cx, cy, lens)
    return Camera(name, intrinsics, look_at(centre, target, up))
