"""The head's diameter from outlines: heads, children and hair pass; a rig in another unit is refused by name."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.scene.rig_scale import times
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.view_checks.head_size import WrongScale, crown_disc, head_diameter_mm, judge_head_size
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.layout import default_layout
from tests.support.subjects import random_subjects, worn_silhouettes

pytestmark = pytest.mark.gl
STYLES = {
    "short": HairStyle(12.0),
    "over ears": HairStyle(20.0, over_ears=True),
    "long": HairStyle(13.0, over_ears=True, hanging_mm=150.0),
    "thick": HairStyle(40.0, over_ears=True),
}


@pytest.fixture(scope="module")
def heads(renderer):
    model, rig, rng = load_model(), default_layout().scaled(0.25), np.random.default_rng(3)
    subjects = random_subjects(len(STYLES), seed=3)
    return rig, {
        name: worn_silhouettes(model, subject, rig, renderer, style, rng)
        for subject, (name, style) in zip(subjects, STYLES.items(), strict=True)
    }


@pytest.mark.parametrize("name", STYLES)
@pytest.mark.parametrize("scale", [0.85, 1.0])
def test_people_pass(heads, name, scale):
    rig, of = heads
    assert judge_head_size(of[name], times(rig, scale)) == []
    few = rig.subset(rig.names[:4])
    assert judge_head_size({camera: of[name][camera] for camera in few.names}, times(few, scale)) == []


@pytest.mark.parametrize("factor", [0.25, 0.45, 2.2, 3.3, 5.0])  # hair 40 mm thick at half its size is a child's head
@pytest.mark.parametrize("name", STYLES)
def test_another_unit_is_refused(heads, name, factor):
    rig, of = heads
    with pytest.raises(WrongScale) as refused:
        judge_head_size(of[name], times(rig, factor))
    ratio = float(str(refused.value).split("about ")[1].split(" times")[0])
    assert 0.75 * factor < ratio < 1.35 * factor
    assert "scale.json" in str(refused.value)


def test_what_is_between_is_warned_of(heads):
    rig, of = heads
    (warning,) = judge_head_size(of["over ears"], times(rig, 1.5))
    assert warning.code == "scale-implausible"
    assert "times as large as a head" in warning.text


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_camera_may_hang_on_its_side(heads, turns):
    _, of = heads
    mask = of["short"]["cam00"].mask
    upright, turned = crown_disc(mask), crown_disc(np.ascontiguousarray(np.rot90(mask, turns)))
    assert upright is not None
    assert turned is not None
    assert turned[1] == pytest.approx(upright[1], abs=2.0)


def test_a_cut_crown_says_nothing(heads):
    rig, of = heads
    cut = {}
    for name, silhouette in of["short"].items():
        rows = np.flatnonzero(silhouette.mask.any(axis=1))
        mask = np.roll(silhouette.mask, -rows[0] - 10, axis=0)
        mask[-rows[0] - 10 :] = mask[-rows[0] - 11]
        cut[name] = replace(silhouette_from_mask(mask), quality=silhouette.quality)
    assert head_diameter_mm(cut, rig) is None
    assert judge_head_size(cut, times(rig, 5.0)) == []
