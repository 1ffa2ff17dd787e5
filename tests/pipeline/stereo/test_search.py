"""The search's size: about as many millimetres a pixel whatever the photographs' size; its room."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.projection import depth_map
from pipeline.multiview.visual_hull import hull_extent
from pipeline.stereo.crops import make_crops
from pipeline.stereo.depth_range import BEFORE_HEAD_MM, DepthRange, find_depth_ranges
from pipeline.stereo.estimate import (
    CONTRAST_LEVELS,
    PIXEL_MM,
    SEARCH_PIXEL_MM,
    choose_neighbours,
    find_fields,
    find_search_level,
    slopes_around,
    square_pattern,
)
from pipeline.stereo.matcher import Matching
from pipeline.stereo.stack import stack_crops
from rig.camera import Camera
from rig.geometry import RigidTransform
from rig.mesh import Mesh
from rig.rig import Rig
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
    fields = find_fields(matching, ranges)
    right = np.concatenate([(np.abs(f.depth - z) < 3.0)[np.isfinite(z)] for f, z in zip(fields, true, strict=True)])
    assert right.mean() > 0.75  # 0.86; below 0.5 with the bounds' slopes


BORDER_PX = 10  # of the lower edge: the hull of what it cuts off has a crease there
NARROW_DEG = 8.0  # between cameras: their hull of a ball reaches several radii before it


def rooms_of(rig: Rig, balls: tuple[Ball, ...], head: Mesh | None) -> list[tuple[DepthRange, Camera, np.ndarray]]:
    """Of each view its room, the camera of that size, and the signed distance (px) to the outline."""
    images, silhouettes = shoot(rig, balls)
    extent = hull_extent(silhouettes, rig)
    crops = make_crops(images, silhouettes, rig, pixel_mm=PIXEL_MM, at_world=extent[0])
    stack = stack_crops(crops, 2)
    rooms = find_depth_ranges(crops, stack_crops(crops, 3), stack, head, extent)
    return [
        (room, crop.levels[2].camera, stack.image(stack.distance_px, view))
        for view, (room, crop) in enumerate(zip(rooms, crops, strict=True))
    ]


def ball_mesh(ball: Ball) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=ball.radius)
    return Mesh(np.asarray(ball.centre) + np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int32))


@pytest.mark.parametrize("apart_deg", [NARROW_DEG, 25.0])
def test_the_surface_lies_in_the_room(apart_deg: float) -> None:
    """Before cameras that stand close together it did not: the room ended 90 mm behind the hull's front."""
    rig, ball = fan(3, apart_deg), Ball()
    mesh = ball_mesh(ball)
    for room, camera, distance in rooms_of(rig, (ball,), mesh):
        true, _ = depth_map(camera, mesh.vertices, mesh.faces)
        seen = np.isfinite(true) & (room.far > 0.0) & (distance < -2.0)
        assert seen.sum() > 100
        assert np.mean((room.near < true)[seen] & (true < room.far)[seen]) > 0.95
        if apart_deg == NARROW_DEG:
            assert (true - room.near)[seen].max() < 1.5 * BEFORE_HEAD_MM


def test_beside_the_head_its_nearest_and_farthest_places_bound_the_room() -> None:
    """A body below the head, farther away: it is beside the head's image, and in the room."""
    rig, head, body = fan(3, NARROW_DEG), Ball(centre=(0.0, 60.0, 0.0)), Ball(centre=(0.0, -60.0, 0.0), radius=70.0)
    meshes = ball_mesh(head), ball_mesh(body)
    for room, camera, distance in rooms_of(rig, (head, body), meshes[0]):
        of_head, of_body = (depth_map(camera, mesh.vertices, mesh.faces)[0] for mesh in meshes)
        beside = np.isfinite(of_body) & ~np.isfinite(of_head) & (distance < -3.0)
        beside[-BORDER_PX:] = False
        assert beside.sum() > 50
        assert np.mean((room.near < of_body)[beside] & (of_body < room.far)[beside]) > 0.95


def test_a_head_beside_all_that_is_seen_bounds_nothing() -> None:
    rig, ball = fan(3, 25.0), Ball()
    away = RigidTransform(np.eye(3), np.array([5000.0, 0.0, 0.0]))
    mesh = ball_mesh(ball)
    beside = rooms_of(rig, (ball,), Mesh(away.apply(mesh.vertices), mesh.faces))
    for (one, _, _), (other, _, _) in zip(beside, rooms_of(rig, (ball,), None), strict=True):
        np.testing.assert_array_equal(one.far, other.far)
