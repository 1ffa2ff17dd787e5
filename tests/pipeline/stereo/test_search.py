"""The search's size: about as many millimetres a pixel whatever the photographs' size."""

import numpy as np
import pytest

from pipeline.stereo.crops import make_crops
from pipeline.stereo.depth_range import DepthRange
from pipeline.stereo.estimate import (
    CONTRAST_LEVELS,
    PIXEL_MM,
    SEARCH_PIXEL_MM,
    choose_neighbours,
    find_search_level,
    first_fields,
    slopes_around,
    square_pattern,
)
from pipeline.stereo.matcher import Matching
from pipeline.stereo.stack import stack_crops
from rig.camera import Camera
from rig.studio.scene.layout import default_layout
from tests.pipeline.stereo import ray_scene
from tests.pipeline.stereo.ray_scene import Ball, fan, first_hit, shoot


@pytest.mark.parametrize(("factor", "level"), [(1.4, 2), (1.0, 2), (0.5, 1), (0.25, 1)])
def test_smaller_photographs_are_halved_less_often(factor: float, level: int) -> None:
    rig = default_layout()
    at_world = rig.centre_world()
    pixel_mm = np.median([np.linalg.norm(c.centre_world - at_world) / c.intrinsics.fx for c in rig]) / factor
    found = find_search_level(list(rig.scaled(factor)), at_world)
    assert found == level
    if factor >= 0.5:
        assert SEARCH_PIXEL_MM / 1.5 < pixel_mm * 2**found < SEARCH_PIXEL_MM * 1.5


BALL = Ball(wave_mm=18.0)


def test_slopes_are_those_of_the_depths_around() -> None:
    row, column = np.indices((40, 50), dtype=np.float32)
    depth = 900.0 + 1.5 * column - 0.7 * row
    depth[::3, ::2] = 0.0  # not known
    found = slopes_around(depth)
    # EVEN_PX2 is 1 in 19 of a window's variance of 9 px2
    assert np.abs(found[9:-9, 9:-9] * 19 / 18 / (1.5, -0.7) - 1.0).max() < 0.01


def true_depth(camera: Camera) -> np.ndarray:
    k = camera.intrinsics
    column, row = np.meshgrid(np.arange(k.width, dtype=float), np.arange(k.height, dtype=float))
    pixels = np.stack([column.ravel(), row.ravel()], axis=1)
    along, _ = first_hit(camera, pixels, (BALL,))
    return (along * (camera.rays_world(pixels) @ camera.camera_from_world.rotation[2])).reshape(k.height, k.width)


def test_places_are_found_where_the_bounds_slope_otherwise_than_the_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WIDTH", "HEIGHT", "FOCAL_PX"):  # a pixel is 2.2 mm, as where depth is first searched
        monkeypatch.setattr(ray_scene, name, getattr(ray_scene, name) // 2)
    rig = fan(3, 20.0)
    images, silhouettes = shoot(rig, (BALL,))
    crops = make_crops(images, silhouettes, rig, pixel_mm=PIXEL_MM, at_world=np.zeros(3))
    cameras = [crop.levels[0].camera for crop in crops]
    matching = Matching(
        stack_crops(crops, 0), choose_neighbours(cameras, np.zeros(3)), square_pattern(2), CONTRAST_LEVELS
    )
    true = [true_depth(camera) for camera in cameras]
    ranges = []
    for z in true:
        near, far = (np.where(np.isfinite(z), z + off, 0.0).astype(np.float32) for off in (-40.0, 35.0))
        ranges.append(DepthRange(near, far, np.full((*z.shape, 4), 3.0, np.float32)))
    fields = first_fields(matching, ranges)
    right = np.concatenate([(np.abs(f.depth - z) < 3.0)[np.isfinite(z)] for f, z in zip(fields, true, strict=True)])
    assert right.mean() > 0.75  # 0.86; below 0.5 with the bounds' slopes
