"""What is known of the views before a fit: too few, a camera that moved, remarks of the reader."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.eigenheads.model import load_model
from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.silhouettes.usable_views import TooFewViews, UsableViews, usable_views
from rig.capture import Capture, Remark
from rig.geometry import RigidTransform, rotation_from_vector
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.silhouette_subjects import dressed_head

pytestmark = pytest.mark.gl
Seen = tuple[Rig, dict[str, Silhouette]]


@pytest.fixture(scope="module")
def seen(renderer: Renderer) -> Seen:
    rig = default_layout().scaled(0.5)
    vertices, faces, pose = dressed_head(load_model(), rig, np.random.default_rng(2), 60)
    with renderer.silhouette_set(rig, faces) as drawn:
        masks = drawn.masks(pose.apply(vertices))
    return rig, {name: silhouette_from_mask(mask) for name, mask in masks.items()}


def judged(rig: Rig, silhouettes: dict[str, Silhouette], capture: Capture | None = None) -> UsableViews:
    return usable_views(capture or Capture({}), rig, lambda shot: silhouettes, exchanged="repair")


def test_good_views_all_take_part_and_remarks_of_the_reader_are_passed_on(seen: Seen) -> None:
    rig, silhouettes = seen
    found = judged(rig, silhouettes, Capture({}, remarks=(Remark("unknown-key", "the key x is not read"),)))
    assert all(silhouette.quality.usable for silhouette in found.silhouettes.values())
    assert [(warning.code, warning.message) for warning in found.warnings] == [("unknown-key", "the key x is not read")]


def test_a_camera_that_was_turned_takes_no_part(seen: Seen) -> None:
    rig, silhouettes = seen
    turn = RigidTransform(rotation_from_vector(np.radians([0.0, 0.5, 0.0])), np.zeros(3))
    cameras = [
        replace(c, camera_from_world=turn @ c.camera_from_world) if c.name == "cam03" else c for c in rig
    ]  # fmt: skip
    found = judged(Rig(tuple(cameras)), silhouettes)
    assert [name for name, silhouette in found.silhouettes.items() if not silhouette.quality.usable] == ["cam03"]
    assert [warning.code for warning in found.warnings] == ["camera-moved"]


def test_two_views_are_too_few_and_each_lost_one_is_named(seen: Seen) -> None:
    rig, silhouettes = seen
    lost = {
        name: s if name in rig.names[:2] else replace(s, quality=replace(s.quality, usable=False))
        for name, s in silhouettes.items()
    }
    with pytest.raises(TooFewViews, match=r"only 2 of 11 .* cam10"):
        judged(rig, lost)
