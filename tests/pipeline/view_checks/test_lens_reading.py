"""Focal lengths of another zoom, planted in a subject with shoulders: the factor is found."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.multiview.tangency import outer_hull
from pipeline.view_checks.camera_assignment import INSET_PX, mean_misfit, tangency_errors_px
from pipeline.view_checks.rig_agreement import find_lens_reading
from rig.rig import Rig

pytestmark = [pytest.mark.gl, pytest.mark.slow]  # the studio takes ten seconds for one capture


@pytest.mark.parametrize("zoom", [1.5, 0.6])
def test_focal_lengths_of_another_zoom_are_found(half_size_shot, zoom):
    shot = half_size_shot
    hulls = [outer_hull(silhouette_from_mask(shot.masks[name]), INSET_PX) for name in shot.rig.names]
    lenses = [replace(c.intrinsics, fx=zoom * c.intrinsics.fx, fy=zoom * c.intrinsics.fy) for c in shot.rig]
    zoomed = Rig(tuple(replace(camera, intrinsics=lens) for camera, lens in zip(shot.rig, lenses, strict=True)))
    found = find_lens_reading(hulls, zoomed, lambda rig: float(np.median(mean_misfit(tangency_errors_px(hulls, rig)))))
    assert found.factor == pytest.approx(1 / zoom, rel=0.06)
    assert max(map(abs, found.shift)) < 0.02
    assert found.is_other
    assert "focal lengths (fx, fy) are taken" in found.message().text
