"""Masks that are true contradict nobody, however few cameras there are; one that lacks a crown does, and is named."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.segmentation.segment import judge_agreement
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from tests.support.subjects import random_subjects, worn_silhouettes

pytestmark = pytest.mark.gl
DIRECTIONS_DEG = {
    "four": [(-45, 5), (-15, 5), (15, 5), (45, 5)],
    "four staggered": [(-60, 0), (-20, 10), (20, -10), (60, 0)],
    "five": [(0, 0), (-40, 5), (40, 5), (-80, 0), (80, 0)],
    "six": [(az, 5) for az in (-75, -45, -15, 15, 45, 75)],
    "two clusters": [(az, 5) for az in (-70, -60, -50, 50, 60, 70)],
}


def rig_of(directions_deg):
    cameras = []
    for number, (azimuth, elevation) in enumerate(directions_deg):
        a, e = np.radians([azimuth, elevation])
        centre = 1200.0 * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        pose = look_at(centre, np.array([0.0, 5.0, 0.0]), np.array([0.0, 1.0, 0.0]))
        cameras.append(Camera(f"cam{number:02}", Intrinsics(512, 384, 1100.0, 1100.0, 255.5, 191.5), pose))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def views(renderer):
    model = load_model()

    def of(directions_deg):
        rig, rng = rig_of(directions_deg), np.random.default_rng(7)
        (subject,) = random_subjects(1, seed=7)
        return rig, worn_silhouettes(model, subject, rig, renderer, HairStyle(20.0, over_ears=True), rng)

    return {name: of(directions_deg) for name, directions_deg in DIRECTIONS_DEG.items()}


@pytest.mark.parametrize("name", DIRECTIONS_DEG)
def test_true_masks_are_believed(views, name):
    rig, silhouettes = views[name]
    for silhouette in judge_agreement(silhouettes, rig).values():
        assert silhouette.quality.usable
        assert silhouette.quality.warnings == ()


@pytest.mark.parametrize("name", ["four", "six"])
def test_a_missing_crown_is_named_and_a_ready_mask_kept(views, name):
    rig, silhouettes = views[name]
    mask = silhouettes["cam01"].mask.copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: rows[0] + (rows[-1] - rows[0]) // 4] = False
    spoilt = silhouettes | {"cam01": replace(silhouette_from_mask(mask), quality=silhouettes["cam01"].quality)}
    judged = judge_agreement(spoilt, rig)
    assert any("the mask lacks" in warning.text for warning in judged["cam01"].quality.warnings)
    assert all(not judged[other].quality.warnings for other in rig.names if other != "cam01")
    assert not judged["cam01"].quality.usable or name == "six"
    ready = judge_agreement(spoilt, rig, ready=rig.names)
    assert ready["cam01"].quality.usable
    assert any("correct the mask" in warning.text for warning in ready["cam01"].quality.warnings)
