"""Moved cameras against planted ones; the subject is a head of the model, bare, its neck cut off."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.eigenheads.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.multiview.camera_drift import _judge, find_drift
from pipeline.multiview.tangency import Tangency, find_tangencies
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout


@pytest.fixture(scope="module")
def seen(renderer):
    rig, model = default_layout(), load_model()
    vertices = model.vertices(0.8 * np.random.default_rng(2).standard_normal(60))
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        masks = drawn.masks(vertices + (10.0, -15.0, 5.0))
    return rig, {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def bumped(rig: Rig, name: str, turn_deg: np.ndarray) -> Rig:
    turn = RigidTransform(rotation_from_vector(np.radians(turn_deg)), np.zeros(3))
    moved = [
        replace(camera, camera_from_world=turn @ camera.camera_from_world) if camera.name == name else camera
        for camera in rig
    ]
    return Rig(tuple(moved))


@pytest.mark.gl
def test_tangent_planes_of_exact_cameras_agree(seen):
    """Contours of binary masks are good to about 0.2 px; two of them, at the tip of a hull, to 0.5 px."""
    rig, silhouettes = seen
    excess = np.array([t.excess_px[0] for t in find_tangencies(silhouettes, rig)])
    assert len(excess) > 40
    assert np.median(np.abs(excess)) < 0.3
    assert find_drift(silhouettes, rig) == ()


@pytest.mark.gl
@pytest.mark.parametrize("angle", [0.0, 75.0, 200.0])
def test_a_turned_camera_is_named_with_its_shift(seen, angle):
    rig, silhouettes = seen
    across = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    for name in rig.names:
        (drift,) = find_drift(silhouettes, bumped(rig, name, 0.2 * across))
        assert drift.camera == name
        assert drift.turn_deg == pytest.approx(0.2, abs=0.06)  # 0.4 px of noise over few equations, at 5 px of shift


@pytest.mark.gl
def test_two_moved_cameras_are_both_named(seen):
    rig, silhouettes = seen
    moved = bumped(bumped(rig, "cam03", np.array([0.3, 0.0, 0.0])), "cam08", np.array([0.1, -0.25, 0.0]))
    assert {drift.camera for drift in find_drift(silhouettes, moved)} == {"cam03", "cam08"}


# Normals and excess (px) of the planes that touched one camera's outline in a simulated photograph, whose mask lacked
# hair where one of them does: only one other plane says anything of the same direction, and it says no.
BAD_STRETCH = [
    *((-0.76, 0.65, 5.98), (-0.74, -0.68, 0.85), (-0.15, 0.99, -0.09), (-0.17, -0.99, 1.49)),
    *((-0.27, 0.96, 0.68), (-0.23, -0.97, 1.74), (0.07, 1.0, -1.6), (0.1, -1.0, 0.27)),
]
NOISE_PX = 0.54  # median of the other cameras' planes


def planes(equations: list[tuple[float, float, float]]) -> list[Tangency]:
    """Those of cam02, and some that it takes no part in."""
    nowhere = np.zeros(2)
    own = [
        Tangency(("cam02", f"cam{k:02}"), (nowhere, nowhere), (1.0, 1.0), (np.array([x, y]), nowhere), (excess, 0.0))
        for k, (x, y, excess) in enumerate(equations, 3)
    ]
    other = Tangency(("cam00", "cam01"), (nowhere, nowhere), (1.0, 1.0), (nowhere, nowhere), (NOISE_PX, -NOISE_PX))
    return [*own, other]


def test_a_bad_stretch_of_one_outline_is_no_moved_camera():
    camera = default_layout()["cam02"]
    assert _judge("cam02", planes(BAD_STRETCH), camera) is None
    shift = np.array([-7.2, -0.7])
    moved = [(x, y, x * shift[0] + y * shift[1]) for x, y, _ in BAD_STRETCH]
    found = _judge("cam02", planes(moved), camera)
    assert found is not None
    np.testing.assert_allclose(found.shift_px, shift, atol=1e-3)
