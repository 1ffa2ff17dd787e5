"""The reduced camera system against dense normal equations by finite differences, and against repeated trials."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.scene.covariance import LENS, camera_places, lens_misfit, reduced_camera_system, uncertainty
from calibration.scene.structure import Structure
from rig.camera import Camera, Distortion
from rig.rig import Rig
from tests.support.textured_wedge import wedge_rig

NOISE_PX = 0.3


def structure(one_lens: bool, points: int = 30) -> Structure:
    """Points on the wedge as its cameras see them, with noise."""
    rig, rng = wedge_rig(), np.random.default_rng(3)
    world = np.column_stack([rng.uniform(-70, 70, points), rng.uniform(-60, 60, points), np.zeros(points)])
    world[:, 2] = -0.6 * np.abs(world[:, 0])
    pixels = np.concatenate([camera.project(world) for camera in rig])
    pixels += rng.normal(0, NOISE_PX, pixels.shape)
    return Structure(
        rig, world, np.repeat(np.arange(len(rig)), points), np.tile(np.arange(points), len(rig)), pixels, one_lens
    )


def stepped(camera: Camera, lens: np.ndarray, pose: np.ndarray) -> Camera:
    """The camera after steps of f k1 k2 cx cy and of its pose."""
    k = camera.intrinsics
    f, k1, k2, cx, cy = lens
    bent = Distortion(k.distortion.k1 + k1, k.distortion.k2 + k2)
    changed = replace(k, fx=k.fx + f, fy=k.fy + f, cx=k.cx + cx, cy=k.cy + cy, distortion=bent)
    return replace(camera, intrinsics=changed).moved(pose)


@pytest.mark.parametrize("one_lens", [True, False])
def test_it_is_the_schur_complement_of_dense_normal_equations(one_lens: bool) -> None:
    observed = structure(one_lens, points=8)
    places = camera_places(observed)
    size, count = int(places.max()) + 1, len(observed.points)

    def residuals(step: np.ndarray) -> np.ndarray:
        cameras = tuple(stepped(c, step[p[:LENS]], step[p[LENS:]]) for c, p in zip(observed.rig, places, strict=True))
        world = observed.points + step[size:].reshape(-1, 3)
        return replace(observed, rig=Rig(cameras), points=world).residuals().ravel()

    h = 1e-6
    columns = [(residuals(h * e) - residuals(-h * e)) / (2 * h) for e in np.eye(size + 3 * count)]
    jacobian = np.stack(columns, axis=1)
    normal = jacobian.T @ jacobian / 10.0**2
    dense = normal[:size, :size] - normal[:size, size:] @ np.linalg.solve(normal[size:, size:], normal[size:, :size])
    ours, _ = reduced_camera_system(observed, 10.0)
    scale = np.sqrt(np.diag(normal)[:size])
    np.testing.assert_allclose(ours / np.outer(scale, scale), dense / np.outer(scale, scale), atol=1e-6)


def test_a_motion_of_the_world_costs_nothing_and_blocks_are_covariances_in_the_subjects_gauge() -> None:
    observed = structure(one_lens=True)
    system, _ = reduced_camera_system(observed, NOISE_PX)
    scaled = system / np.sqrt(np.outer(np.diag(system), np.diag(system)))
    assert (np.linalg.eigvalsh(scaled)[:7] < 1e-9).all()
    assert np.linalg.eigvalsh(scaled)[7] > 1e-9
    found = uncertainty(observed)
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.15)  # of 360 residuals: 4 % for normal ones, MAD 6 %
    for block in found.blocks:
        assert np.linalg.eigvalsh(block).min() > 0
    assert (found.pose_sigma_px > 0.05).all()


@pytest.mark.parametrize(("bend", "least", "most"), [(0.0, 0.3, 2.2), (0.3, 4.0, np.inf)])
def test_lenses_that_differ_are_noticed_and_widen_what_is_claimed(bend: float, least: float, most: float) -> None:
    """Fifteen values more: chi-squared by its number is 1 with a deviation of sqrt(2 / 15) = 0.37; three of them.
    Every second camera saw through a lens that bends more; the structure has one."""
    observed = structure(one_lens=True, points=600)
    pixels = observed.pixels.copy()
    for index, camera in enumerate(observed.rig):
        of_camera = observed.camera_of == index
        k = camera.intrinsics
        wide = replace(camera, intrinsics=replace(k, distortion=Distortion(k1=bend)))
        shift = wide if index % 2 else camera
        pixels[of_camera] += shift.project(observed.points[observed.point_of[of_camera]])
        pixels[of_camera] -= camera.project(observed.points[observed.point_of[of_camera]])
    observed = replace(observed, pixels=pixels)
    assert least < lens_misfit(observed, NOISE_PX) < most
    alone = uncertainty(replace(observed, pixels=structure(one_lens=True, points=600).pixels))
    assert (uncertainty(observed).pose_sigma_px >= 0.99 * alone.pose_sigma_px).all()
