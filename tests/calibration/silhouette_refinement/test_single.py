"""Cameras brought back by one capture's silhouettes, and left alone where pairs that were held out do not agree."""

import numpy as np
import pytest

from calibration.adjustment.gauge import image_distance
from calibration.scene.scene import VIEWS_LEAST, refine_one
from rig.render.renderer import Renderer
from rig.studio.scene.layout import rig_from_directions
from tests.support.silhouette_subjects import captures_of, disturbed, rms

AROUND = [(float(azimuth), elevation) for elevation in (-20.0, 12.0) for azimuth in np.linspace(-90.0, 90.0, 8)]


@pytest.mark.slow
@pytest.mark.gl
def test_one_capture_brings_cameras_nearer_that_are_off_by_a_pixel(renderer: Renderer) -> None:
    rng = np.random.default_rng(3)
    truth = rig_from_directions(AROUND)
    (seen,) = captures_of(renderer, truth, 1, rng)
    start = disturbed(truth, 1.0, rng)
    done = refine_one(seen, start)
    assert done is not None
    refined, reason = done
    assert reason.code == "refinement-pairs-shrink", reason
    assert rms(image_distance(refined, truth, scale=True)) < 0.85 * rms(image_distance(start, truth, scale=True))
    exact = refine_one(seen, truth)
    assert exact is not None
    assert exact[0] is truth, exact[1]
    few = {name: seen[name] for name in truth.names[: VIEWS_LEAST - 1]}
    assert refine_one(few, truth) is None
