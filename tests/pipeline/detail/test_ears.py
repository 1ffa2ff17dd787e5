"""Ears of the default head, moved and found again, or hidden."""

import numpy as np
import pytest

from pipeline.detail.dense_points import SurfacePoints, thin
from pipeline.detail.ears import move_ears
from pipeline.head_model.model import load_model
from pipeline.head_model.regions import head_regions
from pipeline.part_labels.codes import Part
from rig.mesh import vertex_normals

RISE_MM = 6.0


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [False, True])
def test_ears_go_where_points_show_them_and_nowhere_when_they_are_hidden(hidden: bool) -> None:
    model = load_model()
    vertices, faces = model.vertices(np.zeros(0)), model.levels["full"].faces
    ears = head_regions(model)["ears"]
    truth = vertices + RISE_MM * ears[:, None] * np.array([0.0, 1.0, 0.0])
    shown = ~ears & (vertices[:, 2] > 0.0) if hidden else np.ones(len(vertices), bool)
    normals = vertex_normals(truth, faces)[shown]
    count = len(normals)
    points = SurfacePoints(truth[shown], normals, np.full(count, 0.2), np.full(count, Part.SKIN, np.uint8))
    found = move_ears(vertices, model, thin(points, 2.5))
    if hidden:
        np.testing.assert_array_equal(found, vertices)
    else:
        rise = (found - vertices)[ears, 1]
        assert np.median(rise) == pytest.approx(RISE_MM, abs=1.0)
