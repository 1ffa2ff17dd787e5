"""Captures stripped of their plates: the studio's backdrops, and another program's."""

import numpy as np
import pytest

from pipeline.segmentation.segment import segment
from pipeline.settings import SegmentationSettings
from pipeline.view_checks.usable_views import view_warnings
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.render.renderer import Renderer
from rig.studio.sensor.preset import PRESET
from tests.pipeline.segmentation.test_segment import true_mask
from tests.pipeline.segmentation.test_segment_studio import RESOLUTION_PX, coverage, iou, rms, take
from tests.support.shared_data import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
CAPTURES = 3


@pytest.mark.gl
def test_masks_of_the_studio_without_its_plates(renderer: Renderer) -> None:
    overlap, off, silent = [], [], []
    for seed in range(CAPTURES):
        taken, _ = take(seed, renderer)
        bare = Capture(taken.capture.images)
        found = segment(bare, taken.rig, SegmentationSettings(), report=lambda *_: None)
        warned = " ".join(warning.text for warning in view_warnings(found))
        for name, silhouette in found.items():
            overlap.append(iou(silhouette, coverage(taken, name, PRESET.defocus_px) >= 0.5))
            off.append(rms(silhouette, coverage(taken, name, RESOLUTION_PX)))
            silent += [f"{seed} {name}"] if overlap[-1] < 0.95 and f"{name}:" not in warned else []
    assert (np.array(overlap) >= 0.99).mean() >= 0.9
    assert np.median(off) <= 0.6
    assert silent == []


@pytest.mark.parametrize("folder", ["scan-a", "draw-b"])
def test_masks_of_another_programs_captures_without_their_plates(folder: str) -> None:
    capture, rig = read_capture(shared(f"data/captures/{folder}"))
    found = segment(Capture(capture.images), rig, SegmentationSettings(), report=lambda *_: None)
    overlap = np.array([iou(silhouette, true_mask(name, folder)) for name, silhouette in found.items()])
    assert (overlap >= 0.99).mean() >= 0.9
    assert overlap.min() >= 0.97
