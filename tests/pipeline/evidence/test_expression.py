"""What a face does, the head without it, and morphs whose weights give it back."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.detail.blink import with_lids
from pipeline.evidence.expression import READ_SIGMA, build_blendshape_rig, found_expressions, neutral_mesh, shut_eyes
from pipeline.head_model.model import HeadModel, load_model, with_expressions, with_modes
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh

PLACE = Similarity(1.1, rotation_from_vector(np.array([0.2, -0.1, 0.3])), np.array([5.0, 60.0, -20.0]))
WEIGHTS = {"mouthSmileLeft": 0.6, "mouth-corner-puller": 0.3, "jawOpen": 0.02}


@pytest.fixture(scope="module")
def posed() -> tuple[HeadModel, Fit, Mesh]:
    model = with_expressions(with_modes(load_model(), 4))
    z = np.zeros(len(model.modes))
    z[:4] = 0.5
    for name, weight in WEIGHTS.items():
        z[model.posed.start + model.expressions.names.index(name)] = weight
    fit = Fit("contour", z, PLACE, 1, "converged", covariance=0.1**2 * np.eye(len(z) + 7))
    return model, fit, Mesh(PLACE.apply(model.vertices(z)), model.levels["full"].faces)


def test_a_report_names_what_is_strong_and_sure_or_what_the_surface_tells(posed: tuple[HeadModel, Fit, Mesh]) -> None:
    model, fit, _ = posed
    found = found_expressions(model, fit)
    assert [(each.words, round(each.weight, 6)) for each in found] == [
        ("mouth smile left", 0.6),
        ("mouth corner puller", 0.3),
    ]
    assert found[0].std == pytest.approx(0.1)
    z = np.zeros(len(fit.coefficients))
    z[model.posed.start + model.expressions.names.index("browInnerUp")] = 0.15  # one and a half deviations
    unsure = replace(fit, coefficients=z)
    assert found_expressions(model, unsure) == ()
    assert [each.words for each in found_expressions(model, unsure, READ_SIGMA)] == ["brow inner up"]


def test_closed_eyes_blink(posed: tuple[HeadModel, Fit, Mesh]) -> None:
    model, fit, _ = posed
    assert shut_eyes(model, fit) == frozenset()
    shut = with_lids(fit, model, {"right": 1.0, "left": 0.0})
    found = found_expressions(model, shut)
    assert (found[0].name, found[0].weight) == ("eyeBlinkRight", 1.0)
    assert shut_eyes(model, shut) == {"right"}


def test_without_its_expression_a_head_is_neutral_and_morphs_give_it_back(posed: tuple[HeadModel, Fit, Mesh]) -> None:
    model, fit, mesh = posed
    neutral = neutral_mesh(model, PLACE, mesh, found_expressions(model, fit))
    taken_back = {"jawOpen": WEIGHTS["jawOpen"]}  # the least weights stay
    truth = PLACE.apply(model.posed_vertices(fit.coefficients[:4], taken_back))
    np.testing.assert_allclose(neutral.vertices, truth, atol=1e-3)
    head = build_blendshape_rig(model, PLACE, mesh, found_expressions(model, fit))
    assert len(head.morphs) == 53  # Apple's, and the puller that has no counterpart among them
    assert head.missing == ("tongueOut",)
    moved = sum(weight * head.morphs[name] for name, weight in head.weights.items())
    np.testing.assert_allclose(head.neutral_world.vertices + moved @ PLACE.rotation.T, mesh.vertices, atol=1e-3)
