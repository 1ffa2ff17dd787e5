"""The drift watch's symptoms, each planted once: a turned camera, loose masks, views cut off, a close-up."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments.faults.drift import drift
from tests.support.spoilt_captures import CLOSE_UP, LOOSE_PX, close_up, loosened

WHOEVER = {"good": 0, "loose": 0, "cut_off": 0, "close_up": 0, "close_up_loose": 0}


@pytest.mark.gl
@pytest.mark.slow
def test_a_turned_camera_is_named_and_no_good_one_is_called_moved(renderer):
    found = drift(load_model(), renderer=renderer, report=lambda stage, share: None, subjects=2)["figures"]
    assert found["turned_called_moved"] == found["captures"] == 2
    assert {condition: found[f"{condition}_good_called_moved"] for condition in WHOEVER} == WHOEVER


def test_loose_masks_reach_farther_on_every_side():
    rows, columns = np.ogrid[:120, :160]
    disk = silhouette_from_mask((rows - 60) ** 2 + (columns - 80) ** 2 < 30**2)
    (loose,) = loosened({"cam": disk}).values()
    np.testing.assert_allclose(disk.distance[60, 75:] - loose.distance[60, 75:], LOOSE_PX, atol=0.5)


def test_a_close_up_shows_the_crown_lower():
    camera = default_layout()["cam00"]
    near, crown = close_up(camera), np.array([[0.0, 120.0, 0.0]])
    assert near.intrinsics.fx == CLOSE_UP * camera.intrinsics.fx
    assert 0.0 < near.project(crown)[0, 1] < near.intrinsics.height / 2
