"""Captures of another program, stripped of their plates; tests/pipeline/segmentation/test_segment_studio.py has the
studio's."""

import numpy as np
import pytest

from pipeline.segmentation.segment import segment
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from tests.pipeline.segmentation.test_segment import true_mask
from tests.pipeline.segmentation.test_segment_studio import iou
from tests.support.shared_data import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.parametrize("folder", ["scan-a", "draw-b"])
def test_masks_of_another_programs_captures_without_their_plates(folder: str) -> None:
    capture, rig = read_capture(shared(f"data/captures/{folder}"))
    found = segment(Capture(capture.images), rig, report=lambda *_: None)
    overlap = np.array([iou(silhouette, true_mask(name, folder)) for name, silhouette in found.items()])
    assert (overlap >= 0.99).mean() >= 0.9
    assert overlap.min() >= 0.97
