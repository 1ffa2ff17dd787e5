"""Cells of a head that a camera nearly touches: one as large as the picture, and no assertion of OpenCV."""

import numpy as np
import pytest

from pipeline.part_labels.appearance_cells import _cell_px, _means
from rig.camera import Camera, Intrinsics
from rig.geometry import RigidTransform

CAMERA = Camera("near", Intrinsics(64, 48, 2000.0, 2000.0, 31.5, 23.5), RigidTransform(np.eye(3), np.zeros(3)))


@pytest.mark.parametrize(("depth_mm", "size_px"), [(1100.0, 4), (10.0, 48), (0.0, 48), (-20.0, 48)])
def test_a_cell_is_no_larger_than_the_picture(depth_mm: float, size_px: int) -> None:
    size = _cell_px(CAMERA, np.array([0.0, 0.0, depth_mm]), 2.2)
    assert size == size_px
    assert min(_means(np.ones((48, 64), np.float32), size).shape) >= 1
