"""The drift watch's symptoms, each planted once: a turned camera, loose masks, views cut off, a close-up."""

import pytest

from pipeline.head_model.model import load_model
from tests.laboratory.experiments.faults.drift import drift
from tests.laboratory.experiments.records import Bench

WHOEVER = {"good": 0, "loose": 0, "cut_off": 0, "close_up": 0, "close_up_loose": 0}


@pytest.mark.gl
@pytest.mark.slow
def test_a_turned_camera_is_named_and_no_good_one_is_called_moved(renderer):
    found = drift(load_model(), renderer=renderer, bench=Bench(), subjects=2)["figures"]
    assert found["turned_called_moved"] == found["captures"] == 2
    assert {condition: found[f"{condition}_good_called_moved"] for condition in WHOEVER} == WHOEVER
