"""Highlights are taken off a ball of skin, and nothing else is: its own colours, also where it stands elsewhere."""

import numpy as np
import pytest

from pipeline.imaging.highlights import GAMMA, LIGHT, MIN_VIEWS, darken_highlights, highlight_levels
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh
from tests.pipeline.stereo.ray_scene import Ball, fan, first_hit, shade
from tests.support.subdivided_spheres import subdivided_sphere

SKIN = np.array([0.42, 0.24, 0.17])  # linear
LAMP = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
SHINE, EXPONENT = 0.35, 25.0  # at the middle of the lobe, linear; how narrow it is
RIG, BALL = fan(5, 20.0), Ball()


def photographs(shine: float) -> tuple[dict[str, np.ndarray], dict[str, Silhouette]]:
    """A ball of skin with fine texture and slow shading, lit from one side, and its silhouettes."""
    images, silhouettes = {}, {}
    for camera in RIG:
        k = camera.intrinsics
        column, row = np.meshgrid(np.arange(k.width), np.arange(k.height))
        pixels = np.stack([column.ravel(), row.ravel()], axis=1).astype(float)
        distance, _ = first_hit(camera, pixels, (BALL,))
        hit = np.isfinite(distance)
        points = camera.centre_world + camera.rays_world(pixels[hit]) * distance[hit, None]
        normals, towards = points / BALL.radius, camera.centre_world - points
        half = LAMP + towards / np.linalg.norm(towards, axis=1, keepdims=True)
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        texture = shade(points, BALL, 1)[:, None] / 128.0
        linear = np.full((len(pixels), 3), 0.3)
        linear[hit] = SKIN * (0.4 + 0.6 * np.clip(normals @ LAMP, 0.0, 1.0))[:, None] * texture
        linear[hit] += shine * np.clip((normals * half).sum(axis=1), 0.0, 1.0)[:, None] ** EXPONENT
        images[camera.name] = np.rint(255.0 * srgb_from_linear(linear)).astype(np.uint8).reshape(k.height, k.width, 3)
        silhouettes[camera.name] = silhouette_from_mask(hit.reshape(k.height, k.width))
    return images, silhouettes


def ball_mesh(shift_mm: float = 0.0) -> Mesh:
    vertices, faces, _ = subdivided_sphere()
    return Mesh(vertices + (shift_mm, 0.0, 0.0), faces)


def test_a_highlight_falls_to_the_skin_s_own_light() -> None:
    (shiny, silhouettes), (matte, _) = photographs(SHINE), photographs(0.0)
    lowered = darken_highlights(shiny, silhouettes, RIG, ball_mesh())
    for camera in RIG:
        name = camera.name
        inside = silhouettes[name].distance < -6.0
        # Against the matte ball's local contrast: what slopes within a window is what misleads a match.
        before = float(np.ptp((shiny[name] - matte[name].astype(float)).mean(axis=2)[inside]))
        after = float(np.ptp((lowered[name] - matte[name].astype(float)).mean(axis=2)[inside]))
        assert before > 60.0
        assert after < 0.5 * before


@pytest.mark.parametrize("shift_mm", [0.0, 3.0])
def test_skin_without_highlights_stays_also_where_the_head_is_off(shift_mm: float) -> None:
    matte, silhouettes = photographs(0.0)
    lowered = darken_highlights(matte, silhouettes, RIG, ball_mesh(shift_mm))
    changed = np.array([np.abs(lowered[name].astype(int) - matte[name]).max(axis=2) > 2 for name in matte])
    assert changed.mean() < 0.01


def test_two_views_decide_nothing_and_none_is_changed() -> None:
    shiny, silhouettes = photographs(SHINE)
    pair = RIG.subset(RIG.names[: MIN_VIEWS - 1])
    lowered = darken_highlights({name: shiny[name] for name in pair.names}, silhouettes, pair, ball_mesh())
    assert all(lowered[name] is shiny[name] for name in pair.names)


def test_added_white_is_told_from_more_of_the_skin_s_own_light() -> None:
    rng = np.random.default_rng(0)
    matt = (SKIN * rng.uniform(0.5, 1.0, (400, 1))).astype(np.float32)
    colours = np.repeat(matt[None], 6, axis=0)
    colours[0, :100] += 0.2
    colours[1, 100:200] *= 1.6
    colours[2, 200:] = np.nan
    excess = highlight_levels(colours, np.zeros((0, 3), np.int32))
    levels = np.where(excess.sure, excess.levels, 0.0)
    light = matt[:100] @ LIGHT
    raised = 255.0 * ((light + 0.2) ** (1.0 / GAMMA) - light ** (1.0 / GAMMA))
    np.testing.assert_allclose(levels[0, :100], raised, rtol=1e-3)
    assert levels[1:].max() == 0.0
    assert levels[0, 100:].max() == 0.0
    np.testing.assert_array_equal(excess.known, np.isfinite(colours[..., 0]))
