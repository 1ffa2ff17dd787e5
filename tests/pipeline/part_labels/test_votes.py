"""Cells that vote on a planted wall: skin on the left, hair on the right, seen by two cameras."""

import numpy as np

from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import part_codes, vote_parts
from pipeline.stereo.depth_map import DepthMap
from rig.camera import Camera, Intrinsics
from rig.geometry import RigidTransform
from rig.rig import Rig

SIZE, FOCAL, DISTANCE_MM = 60, 100.0, 100.0  # a pixel is a mm on the wall


def wall_camera(name: str, x_mm: float) -> Camera:
    lens = Intrinsics(SIZE, SIZE, FOCAL, FOCAL, (SIZE - 1) / 2, (SIZE - 1) / 2)
    return Camera(name, lens, RigidTransform(np.eye(3), np.array([-x_mm, 0.0, DISTANCE_MM])))


def seen_wall(camera: Camera) -> DepthMap:
    shape = (SIZE, SIZE)
    return DepthMap(
        camera=camera,
        depth_mm=np.full(shape, DISTANCE_MM, np.float32),
        normal=np.broadcast_to(np.array([0, 0, -1], np.float32), (*shape, 3)).copy(),
        deviation_mm=np.full(shape, 0.2, np.float32),
        views=np.full(shape, 2, np.uint8),
    )


def part_map(camera: Camera, border_mm: float) -> PartMap:
    """Hair to the right of the border."""
    x = np.arange(SIZE) - (SIZE - 1) / 2 + camera.centre_world[0]
    hair = np.broadcast_to(x > border_mm, (SIZE, SIZE))
    return PartMap(camera.name, 255 * np.stack([~hair, hair, np.zeros_like(hair)], axis=-1).astype(np.uint8))


def test_cells_say_what_most_of_their_pixels_show_and_a_view_without_parts_does_not_vote() -> None:
    rig = Rig((wall_camera("a", 0.0), wall_camera("b", 6.0)))
    maps = [seen_wall(camera) for camera in rig]
    votes = vote_parts(maps, {camera.name: part_map(camera, 0.0) for camera in rig}, rig)
    assert votes is not None
    x = np.linspace(-28.0, 28.0, 15)
    points = np.column_stack([x, np.zeros(15), np.zeros(15)])
    expected = np.where(x > 0, Part.HAIR, Part.SKIN)
    clear = np.abs(x) > 4.0  # a cell away from the border
    np.testing.assert_array_equal(part_codes(votes, points)[clear], expected[clear])
    beyond = np.array([[-500.0, 0.0, 0.0], [28.0, 3.0, 40.0]])  # no cell holds them: the nearest one says
    np.testing.assert_array_equal(part_codes(votes, beyond), [Part.SKIN, Part.HAIR])
    assert vote_parts(maps, {}, rig) is None
    votes = vote_parts(maps, {"b": part_map(rig["b"], 0.0)}, rig)
    assert votes is not None
    assert votes.probability.sum(axis=1).min() > 0.99
