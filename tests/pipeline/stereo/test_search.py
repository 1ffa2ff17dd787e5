"""The search's size: about as many millimetres a pixel whatever the photographs' size."""

import numpy as np
import pytest

from pipeline.stereo.search import SEARCH_PIXEL_MM, find_search_level
from rig.studio.scene.layout import default_layout


@pytest.mark.parametrize(("factor", "level"), [(1.4, 2), (1.0, 2), (0.5, 1), (0.25, 1)])
def test_smaller_photographs_are_halved_less_often(factor: float, level: int) -> None:
    rig = default_layout()
    at_world = rig.centre_world()
    pixel_mm = np.median([np.linalg.norm(c.centre_world - at_world) / c.intrinsics.fx for c in rig]) / factor
    found = find_search_level(list(rig.scaled(factor)), at_world)
    assert found == level
    if factor >= 0.5:
        assert SEARCH_PIXEL_MM / 1.5 < pixel_mm * 2**found < SEARCH_PIXEL_MM * 1.5
