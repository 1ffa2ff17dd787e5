"""The judgement of real photographs, where the answer is known: a ball, and a studio subject of thirteen views."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.geometry.projection import depth_map, picture
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.settings import OutputSettings, Settings
from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.geometry import RigidTransform
from rig.progress import discard_progress
from rig.render.renderer import Renderer
from rig.studio.scene.layout import rig_from_directions
from rig.studio.scene.simulate import simulate
from server.tasks.subjects import drawn_subject
from tests.laboratory.experiments.faults.real import RealCapture, choose, judge, outline_px, psnr_db, views_in_front
from tests.support.scenes import ellipsoid
from tests.support.small_studio import CLEAN

AWAY = RigidTransform(np.eye(3), np.array([0.0, 0.0, 600.0]))
CAMERA = Camera("cam00", Intrinsics(320, 240, 400.0, 400.0, 159.5, 119.5), AWAY)
AROUND = (*((a, e) for a in (-80, -40, 0, 40, 80) for e in (-15, 20)), (0, 40), (20, 0), (-20, 0), (180, 0), (150, 10))
HEAD_OF_SPAN = Settings(detail="span", outputs=OutputSettings(surface="head"))


def test_an_outline_that_is_two_pixels_off_is_told_so() -> None:
    ball = ellipsoid(4)
    shown = np.isfinite(depth_map(CAMERA, ball.vertices, ball.faces)[0])
    assert outline_px(CAMERA, ball, shown) < 0.6
    assert outline_px(CAMERA, ball, np.roll(shown, 2, axis=1)) == pytest.approx(1.3, abs=0.4)  # 2 |cos|, of all ways
    assert outline_px(CAMERA, ball, np.zeros_like(shown) | (np.arange(320) < 5)) > 20


def test_colours_are_compared_after_the_exposure() -> None:
    """Noise of four levels is 20 log10(255 / 4) = 36 dB, whatever the gain between the two."""
    ball, rng = ellipsoid(4), np.random.default_rng(0)
    colours = rng.integers(90, 110, (len(ball.vertices), 3), dtype=np.uint8)
    drawn = picture(CAMERA, ball.vertices, ball.faces, colours).astype(float)
    shown = silhouette_from_mask(np.isfinite(depth_map(CAMERA, ball.vertices, ball.faces)[0]))
    for gain in (1.0, 1.5):
        image = np.clip(np.rint(gain * drawn + rng.normal(0, 4, drawn.shape)), 0, 255).astype(np.uint8)
        assert psnr_db(CAMERA, ball, colours, image, shown) == pytest.approx(36.1, abs=0.3)


def test_views_are_chosen_in_front_and_apart_from_what_judges_them() -> None:
    rig = rig_from_directions(AROUND)
    front = views_in_front(rig, "cam05")
    assert set(rig.names) - set(front) == {"cam13", "cam14"}
    assert set(views_in_front(rig, "cam13")) >= {"cam13", "cam14"}
    masks = {n: silhouette_from_mask(np.pad(np.ones((20, 20), bool), 8)) for n in rig.names}
    drawn = {"cam00": np.ones((36, 36), bool), "cam01": np.ones((36, 36), bool)}
    real_capture = RealCapture("all around", Capture({}), rig, drawn)
    used = choose(real_capture, front, masks)
    assert len(used) == 11
    assert not set(used) & set(drawn)
    assert len(choose(replace(real_capture, drawn={n: drawn["cam00"] for n in front}), front, masks)) == 11


@pytest.mark.slow
@pytest.mark.gl
def test_a_studio_subject_is_judged_by_the_views_that_were_held_out(renderer: Renderer) -> None:
    """No noise, true masks: the outline lies within the mean head's own error in the span, colours fit."""
    rng = np.random.default_rng(5)
    model = load_model()
    taken = simulate(drawn_subject(model, rng), rig_from_directions(AROUND).scaled(0.4), CLEAN, rng, renderer=renderer)
    masks = taken.masks
    real_capture = RealCapture("anna", Capture(taken.capture.images, masks=masks), taken.rig, masks, "cam04")
    row = judge(model, real_capture, renderer=renderer, settings=HEAD_OF_SPAN, report=discard_progress)
    assert (row["views"], row["held_out"], row["surface"]) == (15, 2, "head")
    assert len(row["used"]) == 11
    assert row["outline_px"] < 3.0
    assert row["psnr_db"] > 20.0
    assert row["points_mm"] < 3.0
    few = replace(real_capture, rig=taken.rig.subset(taken.rig.names[:11]))
    with pytest.raises(InputError, match="11 views of use on the front side; more than 11 are needed"):
        judge(model, few, renderer=renderer, settings=HEAD_OF_SPAN, report=discard_progress)
