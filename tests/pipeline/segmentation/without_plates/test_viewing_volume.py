"""A ball before many cameras: what the others say of a pixel is whether its ray meets the ball."""

import numpy as np
import pytest

from pipeline.segmentation.without_plates.viewing_volume import ask_other_views, build_volume, reachable, viewing_ball
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig

SIZE = (96, 128)
RADIUS_MM = 60.0


def ring(count: int = 9) -> Rig:
    lens = Intrinsics(512, 384, 600.0, 600.0, 255.5, 191.5)
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    centres = [np.array([700 * np.sin(a), 120 * np.cos(3 * a), 700 * np.cos(a)]) for a in turns]
    up = np.array([0.0, 1.0, 0.0])
    return Rig(tuple(Camera(f"c{i}", lens, look_at(c, np.zeros(3), up)) for i, c in enumerate(centres)))


def from_ball(camera: Camera, radius: float) -> np.ndarray:
    """How far (mm) each pixel's ray passes outside a ball about the origin, negative inside."""
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    at = (np.stack([column.ravel(), row.ravel()], axis=1) + 0.5) * 4 - 0.5
    rays = camera.rays_world(at)
    off = np.linalg.norm(np.cross(rays, camera.centre_world), axis=1)
    return (off - radius).reshape(SIZE)


def test_the_ball_reaches_the_images_corners() -> None:
    centre, radius = viewing_ball(ring())
    assert np.linalg.norm(centre) < 1e-6
    assert radius == pytest.approx(
        np.linalg.norm(ring().cameras[0].centre_world) / 600 * np.hypot(512, 384) / 2, rel=0.02
    )


def test_other_views_hold_the_ball_and_deny_what_is_beside_it() -> None:
    rig = ring()
    volume = build_volume(rig, dict.fromkeys(rig.names, SIZE), viewing_ball(rig))
    odds = {c.name: np.where(from_ball(c, RADIUS_MM) < 0, 5.0, -5.0).astype(np.float32) for c in rig}
    odds["c0"][:] = -5.0  # this view is blind, and asks
    others = ask_other_views(volume, odds)["c0"]
    beside = from_ball(rig["c0"], RADIUS_MM)
    voxel_mm = 2 * volume.radius_mm / 96
    assert (others.support[beside < -2 * voxel_mm] > 0).all()
    # Eight views leave a hull that is wider than the ball by 1 / cos(pi / 8), 8 %, and by voxels.
    assert (others.support[beside > 0.09 * RADIUS_MM + 3 * voxel_mm] < 0).all()
    assert others.solid[beside < -4 * voxel_mm].all()
    assert not others.solid[beside > 0.09 * RADIUS_MM].any()


def test_nothing_is_left_beyond_the_plane() -> None:
    rig = ring()
    plane = np.array([0.0, 1.0, 0.0, 0.0])  # what is above y = 0 stays
    volume = build_volume(rig, dict.fromkeys(rig.names, SIZE), viewing_ball(rig), plane_world=plane)
    level = [camera for camera in rig if abs(camera.centre_world[1]) < 70]
    assert level
    for camera in level:
        mask = reachable(volume, camera.name, SIZE)
        assert mask[10, SIZE[1] // 2]
        assert not mask[-1].any()
