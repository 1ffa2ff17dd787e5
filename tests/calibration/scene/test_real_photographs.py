"""Real photographs, and the studio's, without a board: against poses that others published, and against the truth."""

import numpy as np
import pytest

from calibration.adjustment.gauge import image_distance
from tests.support.scene_calibrations import buddha, studio


@pytest.mark.slow
def test_the_buddhas_cameras_are_the_published_ones() -> None:
    """Every second photograph at half its size: too few for all to join (21 of 34 do); those that do stand where the
    published poses say, and the others are named."""
    found, agrees = buddha(every=2, size=0.5)
    assert len(found.rig) >= 17
    assert len(found.rig) + len(found.left_out) == 34
    assert agrees.mean_px < 0.5


@pytest.mark.slow
@pytest.mark.gl
def test_thirty_views_of_the_studio_join() -> None:
    """Lenses that differ by 3 % stand as one: a pixel at the subject is what silhouettes then refine."""
    found, truth = studio(seed=1, views=30)
    assert len(found.rig) >= 27
    assert np.median(image_distance(found.rig, truth.subset(found.rig.names), scale=True)) < 1.0
    assert found.scale.assumed
