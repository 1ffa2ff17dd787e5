"""The head as its face tells, and three views of a plain room that have nothing else to begin with."""

import numpy as np
import pytest

from pipeline.segmentation.segment import segment
from pipeline.segmentation.without_plates.decide import solid_around
from pipeline.segmentation.without_plates.head_seed import HeadSeed, above_chin, beside_head, head_core
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from tests.pipeline.segmentation.test_segment import true_mask
from tests.pipeline.segmentation.test_segment_studio import iou
from tests.support.scenes import fan
from tests.support.shared_data import shared


def seed_at(centre: np.ndarray, camera, radius_mm: float = 62.0) -> HeadSeed:
    up = -camera.camera_from_world.rotation[1]
    return HeadSeed(centre, up, radius_mm, {camera.name: np.tile(camera.project(centre[None]), (468, 1))})


def test_the_core_is_the_disc_of_the_skull() -> None:
    camera = fan(640, 480).cameras[0]
    centre = np.zeros(3)
    core = head_core(seed_at(centre, camera), camera, (240, 320))
    row, column = np.argwhere(core).mean(axis=0)
    expected = (camera.project(centre[None])[0] + 0.5) / 2 - 0.5
    np.testing.assert_allclose((column, row), expected, atol=1.0)
    depth = camera.camera_from_world.apply(centre)[2]
    radius = 62.0 / depth * camera.intrinsics.fx / 2
    assert core.sum() == pytest.approx(np.pi * radius**2, rel=0.1)


def test_nothing_behind_the_camera_is_the_head() -> None:
    camera = fan(640, 480).cameras[0]
    behind = camera.centre_world - 300.0 * camera.axis_world
    seed = HeadSeed(behind, -camera.camera_from_world.rotation[1], 62.0, {})
    assert not head_core(seed, camera, (240, 320)).any()
    assert not beside_head(seed, camera, (240, 320)).any()


def test_what_is_beside_the_head_holds_neither_head_nor_body_and_clothes_alone_are_below_the_chin() -> None:
    camera = fan(640, 480).cameras[0]
    seed = seed_at(np.zeros(3), camera)
    beside, core = beside_head(seed, camera, (240, 320)), head_core(seed, camera, (240, 320))
    assert beside.any()
    assert not (beside & core).any()
    below = camera.project(np.array([[0.0, 0.0, 0.0]]) - 200.0 * seed.up_world)[0] / 2
    assert below[1] >= 240 or not beside[int(below[1])].any()
    above, core = above_chin(seed, camera, (480, 640)), head_core(seed, camera, (480, 640))
    assert above[core].all()
    chest = camera.project(-120.0 * seed.up_world[None])[0]
    assert not above[int(chest[1]), int(chest[0])]


def test_a_cut_keeps_the_head_and_has_no_holes() -> None:
    core = np.zeros((40, 40), bool)
    core[10:16, 10:30] = True
    share = np.zeros((40, 40), np.float32)
    share[8:36, 8:32] = 0.9
    share[12, 12:20] = 0.1  # the forehead
    share[24:28, 14:20] = 0.2  # a hole in the shirt
    share[30:36, 20:22] = 0.3  # a gap that is open below
    solid = solid_around(core, share)
    assert (solid[core] > 0.5).all()
    assert (solid[24:28, 14:20] > 0.5).all()
    assert (solid[30:36, 20:22] < 0.5).all()
    assert solid[:8].max() == 0.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_three_frontal_views_before_a_plain_wall_need_neither_plate_nor_mask() -> None:
    capture, rig = read_capture(shared("data/captures/three-brows"))
    found = segment(Capture(capture.images), rig, report=lambda *_: None)
    overlap = [iou(silhouette, true_mask(name, "three-brows")) for name, silhouette in found.items()]
    assert all(silhouette.quality.usable for silhouette in found.values())
    assert min(overlap) > 0.95, overlap
