"""Feature points against the face in the photographs: those beside it are refused, those on it are not."""

import numpy as np
import pytest

from pipeline.alignment.feature_checks import features_beside_face
from pipeline.faces.landmark_map import landmark_map
from pipeline.head_model.landmarks import SEVEN_POINTS
from pipeline.head_model.model import load_model
from rig.capture import Features
from rig.studio.scene.layout import default_layout
from tests.pipeline.alignment.test_suggested_points import VIEWS, WORLD_FROM_HEAD, found_on

MODEL = load_model()


def picked(offset_px: tuple[float, float], share: float = 1.0, noise_px: float = 6.0) -> Features:
    """Points on a head that is not the mean one, all moved and scaled."""
    rng, rig = np.random.default_rng(4), default_layout()
    vertices = MODEL.vertices(np.random.default_rng(3).normal(size=8))
    at = {n: WORLD_FROM_HEAD.apply(vertices[MODEL.levels["full"].landmarks[n]][None]) for n in SEVEN_POINTS}
    return {
        name: {v: share * rig[v].project(point)[0] + offset_px + rng.normal(0, noise_px, 2) for v in VIEWS}
        for name, point in at.items()
    }


@pytest.mark.parametrize(
    ("offset_px", "share", "word"),
    [
        ((0.0, 0.0), 1.0, None),
        ((70.0, 0.0), 1.0, "+70 px"),
        ((0.0, -70.0), 1.0, "-70 px"),
        ((0.0, 0.0), 0.5, "0.5"),
        ((0.0, 0.0), 0.8, "0.8"),
    ],
)
def test_points_of_another_crop_or_size_lie_beside_the_face(
    offset_px: tuple[float, float], share: float, word: str | None
) -> None:
    rig, places = default_layout(), landmark_map(MODEL)
    face = found_on(MODEL.vertices(np.random.default_rng(3).normal(size=8)), places, rig)
    found = features_beside_face(picked(offset_px, share), face, rig, MODEL, places)
    assert (found is None) == (word is None)
    if share != 1.0:
        assert found is not None
        assert found.code == "features-of-size"
        assert found.parameters["factor"] == pytest.approx(share, rel=0.03)
    elif found is not None:
        assert int(str(word).split()[0]) == pytest.approx(
            max((float(str(found.parameters[side])) for side in ("right_px", "down_px")), key=abs), abs=12
        )


def test_points_of_no_landmark_say_nothing_and_rows_that_count_from_the_bottom_are_named() -> None:
    rig, places = default_layout(), landmark_map(MODEL)
    face = found_on(MODEL.vertices(np.random.default_rng(3).normal(size=8)), places, rig)
    assert features_beside_face({"nobody": {"cam00": np.zeros(2)}}, face, rig, MODEL, places) is None
    turned = {
        name: {v: np.array([x, rig[v].intrinsics.height - 1 - y]) for v, (x, y) in views.items()}
        for name, views in picked((0.0, 0.0)).items()
    }
    found = features_beside_face(turned, face, rig, MODEL, places)
    assert found is not None
    assert found.code == "features-from-bottom"
