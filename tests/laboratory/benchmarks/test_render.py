"""Time of one silhouette evaluation: the brief is 15 ms for eleven views of 5,000 triangles at 512 x 384."""

import numpy as np
import pytest

from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.render.renderer import Renderer
from rig.rig import Rig

pytestmark = pytest.mark.gl


def _head(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid of head size, open at both poles: 4 * rings^2 triangles."""
    polar, around = np.meshgrid(np.linspace(0.05, 3.09, rings + 1), np.arange(2 * rings) * np.pi / rings, indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], axis=-1)
    i, j = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = i * 2 * rings + j, i * 2 * rings + (j + 1) % (2 * rings)
    c, d = a + 2 * rings, b + 2 * rings
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return points.reshape(-1, 3) * (80.0, 130.0, 100.0), faces


def _rig() -> Rig:
    lens = Distortion(-0.08, 0.03, 5e-4, -5e-4)
    cameras = []
    for i in range(11):
        angle = 0.27 * (i - 5)
        centre = 1200.0 * np.array([np.sin(angle), 0.3 * (i % 3 - 1), np.cos(angle)])
        pose = look_at(centre, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        cameras.append(Camera(f"cam{i:02}", Intrinsics(1024, 768, 1900.0, 1900.0, 505.0, 390.0, lens), pose))
    return Rig(tuple(cameras))


@pytest.mark.parametrize("rings", [35, 146], ids=["5k", "85k"])
def test_xor_costs(benchmark, rings):
    vertices, faces = _head(rings)
    with Renderer.create() as renderer, renderer.silhouette_set(_rig(), faces, scale=0.5) as silhouettes:
        masks = silhouettes.masks(vertices)
        silhouettes.set_inputs(masks, {name: np.ones(mask.shape, np.float32) for name, mask in masks.items()})
        benchmark(silhouettes.xor_costs, vertices + 3.0)
