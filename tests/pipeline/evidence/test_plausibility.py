"""Results that no head is, and good ones that nothing is said of."""

from functools import cache

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.camera_metrics import CameraFigures
from pipeline.evidence.plausibility import (
    ImplausibleResult,
    plausibility_warnings,
    refuse,
    size_of,
    unexplained_outlines,
    unseen_face,
)
from pipeline.head_model.model import load_model
from pipeline.settings import Settings, settings_from_document
from rig.errors import InputError
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.messages.message import compose

WIDTHS = {f"cam{k:02}": 1024 for k in range(11)}


@cache
def standard_model():
    return load_model()


def fit_of(coefficients, scale=1.0):
    return Fit("contour", coefficients, Similarity(scale, np.eye(3), np.zeros(3)), 1, "converged")


def codes(coefficients, scale=1.0, outside_px=None):
    fit = fit_of(coefficients, scale)
    outside = dict.fromkeys(WIDTHS, 0.2) | (outside_px or {})
    figures = {name: CameraFigures(True, 0.98, 60.0, 100.0, outside_rms_px=value) for name, value in outside.items()}
    return [warning.code for warning in plausibility_warnings(fit, standard_model(), figures, WIDTHS)]


def test_heads_of_the_prior_are_plausible():
    rng = np.random.default_rng(0)
    model, warned = standard_model(), []
    for _ in range(600):
        z = rng.standard_normal(len(model.modes))
        z[list(model.posed)] = 0.0
        warned += codes(z, float(np.exp(0.01 * rng.normal())))
    assert max(map(warned.count, set(warned)), default=0) <= 6  # 1 in 200 are 3, and chance


@pytest.mark.parametrize(("scale", "named"), [(1.053, False), (0.96, False), (1.09, True), (0.91, True)])
def test_a_scale_beyond_other_populations_is_named(scale, named):
    assert codes(np.zeros(60), scale) == (["scale-implausible"] if named else [])


@pytest.mark.parametrize(
    ("scale", "true_sigmas", "named"), [(0.88, 0.0, True), (1.14, 0.0, True), (0.88, 1.0, False), (1.0, 2.0, False)]
)
def test_a_size_that_few_heads_have_is_named_whichever_took_it_up(scale, true_sigmas, named):
    """A rig that is 12 % off is taken up by the shape, as heads differ by 4 %: of a head that is a deviation larger
    itself nothing is told, as it would be of too many good ones."""
    model = standard_model()
    face = np.flatnonzero(model.levels["full"].face_region)[::4]
    mean = model.vertices(np.zeros(0))[face]
    arms = mean - mean.mean(axis=0)
    by_mode = np.einsum("mvc,vc->m", model.basis("full", len(model.modes), face).astype(float), arms) / (arms**2).sum()
    by_mode[list(model.posed)] = 0.0
    spread = float(np.linalg.norm(by_mode))  # of log size, z ~ N(0, I)
    assert 0.035 < spread < 0.045
    z = (np.log(scale) / spread + true_sigmas) * by_mode / spread  # the likeliest head of that size
    assert codes(z) == (["size-unusual"] if named else [])
    assert size_of(fit_of(z), model)[1] == pytest.approx(np.log(scale) / spread + true_sigmas, abs=0.25)


def test_a_camera_whose_contour_the_head_misses_is_named():
    assert codes(np.zeros(60), outside_px={"cam03": 13.0}) == ["contour-implausible"]
    assert codes(np.zeros(60), outside_px={"cam03": 1.0}) == []
    assert codes(np.zeros(60)) == []  # 60 px inside every outline: hair, shoulders


def test_named_codes_become_failures():
    warnings = [
        compose("scale-implausible", finding=compose("head-scale-off", scale=1.2)),
        compose("features", remark="one left out"),
    ]
    refuse(warnings, ())
    refuse(warnings, ("camera-moved",))
    with pytest.raises(ImplausibleResult, match="the scale is implausible: the fitted head has"):
        refuse(warnings, ("scale-implausible",))


def test_settings_take_codes_that_there_are():
    assert settings_from_document({"fail_on": ["scale-implausible"]}).fail_on == ("scale-implausible",)
    assert Settings().fail_on == ()
    for wrong in (["scale"], "scale-implausible", [3]):
        with pytest.raises(InputError, match="fail_on"):
            settings_from_document({"fail_on": wrong})


def explained(shares, rms_px, used=True):
    return {
        f"cam{k:02}": CameraFigures(used, 0.98, rms, 100.0, excluded_share=share)
        for k, (share, rms) in enumerate(zip(shares, rms_px, strict=True))
    }


@pytest.mark.parametrize(
    ("shares", "rms_px", "pixel_mm", "refused"),
    [
        pytest.param([1.0] * 7 + [0.3] * 4, [120.0] * 7 + [20.0] * 4, 0.5, True, id="a doll in the face"),
        pytest.param([0.16, 0.96, 1.0, 0.17, 0.66, 0.58, 0.59, 0.0, 0.08, 0.0, 0.0],
                     [3, 115, 30, 13, 38, 7, 11, 0.4, 6, 0.3, 0.4], 0.5, False, id="hair over the ears"),
        pytest.param([1.0] * 9 + [0.2] * 2, [9.0] * 11, 0.24, False, id="large pictures: 2 mm off"),
        pytest.param([1.0] * 3, [100.0] * 3, 0.5, True, id="three views"),
    ],
)  # fmt: skip
def test_a_head_that_explains_no_outline_is_refused(shares, rms_px, pixel_mm, refused):
    cameras = explained(shares, rms_px)
    text = unexplained_outlines(cameras, {name: pixel_mm for name in cameras})
    assert (text is not None) == refused
    assert not refused or f"{sum(s >= 0.9 for s in shares)} of {len(shares)} views" in str(text)


def test_views_without_a_rim_and_views_left_out_have_no_say():
    bad = explained([1.0] * 3, [100.0] * 3, used=False)
    none = {"cam09": CameraFigures(True, None, None, None)}
    assert unexplained_outlines(bad | none, dict.fromkeys(bad | none, 0.5)) is None


@pytest.mark.parametrize(
    ("azimuths_deg", "unseen"), [((35, 38, 65), True), ((0, 35, -65), False), ((-40, 0, 40), False)]
)
def test_a_face_that_no_camera_sees_on_one_side_is_named(azimuths_deg: tuple[int, ...], unseen: bool) -> None:
    """Cameras at these azimuths see what is turned towards them by 20 degrees or more."""
    level = standard_model().levels["full"]
    normals = Mesh(standard_model().vertices(np.zeros(0)), level.faces).normals()
    ways = np.array([(np.sin(a), 0.1, np.cos(a)) for a in np.radians(azimuths_deg)])
    views = (normals @ ways.T > np.sin(np.radians(20))).sum(axis=1).astype(np.uint8)
    found = unseen_face(views, level.face_region)
    assert (found is not None) == unseen
    assert found is None or "no camera sees" in found.text
