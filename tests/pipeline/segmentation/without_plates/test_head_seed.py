"""The head as its face tells, and three views of a plain room that have nothing else to begin with."""

import numpy as np
import pytest

from pipeline.segmentation.segment import segment
from pipeline.segmentation.without_plates.head_seed import HeadSeed, beside_head, head_core
from pipeline.settings import SegmentationSettings
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


def test_what_is_beside_the_head_holds_neither_head_nor_body() -> None:
    camera = fan(640, 480).cameras[0]
    seed = seed_at(np.zeros(3), camera)
    beside, core = beside_head(seed, camera, (240, 320)), head_core(seed, camera, (240, 320))
    assert beside.any()
    assert not (beside & core).any()
    below = camera.project(np.array([[0.0, 0.0, 0.0]]) - 200.0 * seed.up_world)[0] / 2
    assert below[1] >= 240 or not beside[int(below[1])].any()


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_three_frontal_views_before_a_plain_wall_need_neither_plate_nor_mask() -> None:
    capture, rig = read_capture(shared("data/captures/three-brows"))
    found = segment(Capture(capture.images), rig, SegmentationSettings(), report=lambda *_: None)
    overlap = [iou(silhouette, true_mask(name, "three-brows")) for name, silhouette in found.items()]
    assert all(silhouette.quality.usable for silhouette in found.values())
    assert min(overlap) > 0.95, overlap
