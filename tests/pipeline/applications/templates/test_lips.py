"""Lips that are nearly shut are shut; an open mouth stays open."""

import numpy as np
import pytest
from jaxtyping import Float, Int

from pipeline.applications.templates.animated import PRESS_MM, shut_lips
from pipeline.geometry.raster import depth_map
from pipeline.head_model.model import load_model
from pipeline.head_model.subdivision import opened_faces
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at


def slit_mm2(vertices: Float[np.ndarray, "v 3"], opened: Int[np.ndarray, "f 3"], middle: np.ndarray) -> float:
    """The area of what is seen between the lips from the front: rays that pass deeper than 15 mm behind them."""
    lens = Intrinsics(240, 120, 3000.0, 3000.0, 119.5, 59.5)
    camera = Camera("front", lens, look_at(middle + (0.0, 0.0, 500.0), middle, np.array([0.0, 1.0, 0.0])))
    depth, _ = depth_map(camera, vertices, opened)
    return float(np.count_nonzero(depth > 515.0)) / 36.0  # 6 px a mm


@pytest.mark.parametrize(("weight", "shuts"), [(0.02, True), (0.04, True), (0.4, False)])
def test_lips_are_shut_where_they_nearly_are(weight: float, shuts: bool) -> None:
    model = load_model()
    opened = opened_faces({name: model.levels[name].faces for name in ("cage", "full")})
    parted = model.vertices(np.zeros(0)) + model.levels["full"].operator @ model.expressions.moved({"jawOpen": weight})
    landmarks = {name: parted[row] for name, row in model.landmarks.items()}
    made, middle = shut_lips(parted, opened, landmarks), landmarks["stomion"]
    before, after = (slit_mm2(each, opened, middle) for each in (parted, made))
    assert before > 4.0
    assert after < 0.1 * before if shuts else after > 0.9 * before
    assert np.abs(made - parted).max() < 2.0 + PRESS_MM
    assert np.linalg.norm(parted[(made != parted).any(axis=1)] - middle, axis=1).max() < 40.0
