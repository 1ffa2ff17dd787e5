import numpy as np
import pytest

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.multiview.visual_hull import hull_extent
from pipeline.segmentation.segment import judge_agreement
from rig.rig import Rig
from tests.support.photographs import trace
from tests.support.scenes import SEMI_AXES, fan


@pytest.fixture(scope="module")
def rig() -> Rig:
    return fan(640, 480, (-150, -110, -75, -40, 0, 40, 75, 110, 150))


@pytest.fixture(scope="module")
def traced(rig: Rig) -> dict[str, Silhouette]:
    return {camera.name: silhouette_from_mask(trace(camera, 0.0)[1]) for camera in rig}


def test_the_extent_is_about_the_body_and_unusable_views_do_not_count(rig: Rig, traced: dict[str, Silhouette]) -> None:
    centre, edge = hull_extent(traced, rig)
    assert np.linalg.norm(centre) < 5.0
    assert 2 * SEMI_AXES.max() < edge < 3 * SEMI_AXES.max()
    empty = silhouette_from_mask(np.zeros((480, 640), bool))
    kept = {name: s for name, s in traced.items() if name != "cam04"}
    centre, edge = hull_extent(kept, rig)
    with_empty = hull_extent(traced | {"cam04": empty}, rig)
    np.testing.assert_array_equal([*with_empty[0], with_empty[1]], [*centre, edge])


def test_good_views_agree_and_planted_faults_are_told(rig: Rig, traced: dict[str, Silhouette]) -> None:
    silhouettes = traced
    for name, silhouette in judge_agreement(silhouettes, rig).items():
        assert silhouette.quality.usable, name
        assert silhouette.quality.warnings == ()
    more, less = silhouettes["cam02"].mask.copy(), silhouettes["cam06"].mask.copy()
    more[100:300, 500:600] = True
    less[:200] = False
    judged = judge_agreement(
        silhouettes | {"cam02": silhouette_from_mask(more), "cam06": silhouette_from_mask(less)}, rig
    )
    assert "other cameras exclude the subject" in judged["cam02"].quality.warnings[0].text
    assert "lacks" in judged["cam06"].quality.warnings[0].text
    assert not judged["cam06"].quality.usable
    fine = [judged[name] for name in rig.names if name not in ("cam02", "cam06")]
    assert all(silhouette.quality.usable for silhouette in fine)
