"""Expressions of a model: names, Apple's counterparts, what a file keeps of them, and heads that make faces;
the shapes of speech."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.head_model.expressions import (
    ARKIT,
    VISEMES,
    Expressions,
    arkit_parts,
    closed_lids,
    mixed,
    visible,
    weights_from_text,
    words,
)
from pipeline.head_model.model import assemble, load_model, with_expressions, with_modes
from pipeline.head_model.model_file import BadModel, read_parts, save_model
from pipeline.head_model.model_names import model_path
from rig.errors import InputError


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("mouthSmile_L", "mouth smile left"),
        ("mouthSmileLeft", "mouth smile left"),
        ("jawOpen", "jaw open"),
        ("eye-left-closure", "eye left closure"),
    ],
)
def test_names_are_said_in_words(name: str, said: str) -> None:
    assert words(name) == said


def test_apples_names_are_52_and_a_shape_that_they_do_not_part_is_both_sides() -> None:
    assert len(set(ARKIT)) == 52
    parts = arkit_parts(("browDown_L", "cheekPuff_R", "cheekPuff_L", "browInnerUp_L"))
    assert (parts["browDownLeft"], parts["cheekPuff"], parts["browInnerUp"], parts["jawOpen"]) == ((0,), (2, 1), (), ())


def test_the_default_model_has_apples_face_units_and_makehumans_own() -> None:
    model = load_model()
    parts = arkit_parts(model.expressions.names)
    assert [name for name in ARKIT if not parts[name]] == ["tongueOut"]  # inside the mouth
    assert "mouth-corner-puller" in model.expressions.names
    smile = model.expressions.moved({"mouthSmileLeft": 0.5})
    corners = [model.landmarks[f"cheilion_{side}"] for side in ("left", "right")]
    assert smile[corners[0], 0] > 2.0  # the left corner moves to the subject's left and up, the right one stays
    assert smile[corners[0], 1] > 2.0
    assert np.abs(smile[corners[1]]).max() < 1.0
    lids = model.expressions.moved({"eyeBlinkRight": 1.0})
    assert np.abs(lids[model.mean[:, 0] > 10]).max() < 0.5


def test_a_file_keeps_expressions_and_one_without_them_is_read(tmp_path: Path) -> None:
    parts, _ = read_parts(model_path("default"))
    assert parts.expressions is not None
    few = Expressions(parts.expressions.names[:2], parts.expressions.shapes[:2])
    save_model(tmp_path / "few.npz", replace(parts, expressions=few))
    kept, _ = read_parts(tmp_path / "few.npz")
    assert kept.expressions is not None
    assert kept.expressions.names == few.names
    np.testing.assert_allclose(kept.expressions.shapes, few.shapes, atol=0.004)
    save_model(tmp_path / "none.npz", replace(parts, expressions=None))
    bare = assemble(read_parts(tmp_path / "none.npz")[0], "")
    assert len(bare.expressions) == 0
    assert with_expressions(bare) is bare


def test_an_expression_of_a_vertex_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    parts, _ = read_parts(model_path("default"))
    save_model(path, parts)
    with np.load(path) as file:
        arrays = dict(file)
    arrays["expression_vertices"] = arrays["expression_vertices"] + len(parts.mean)
    np.savez(path, **arrays)
    with pytest.raises(BadModel, match="not there"):
        read_parts(path)


def test_weights_are_coefficients_of_further_modes() -> None:
    model = load_model()
    posed = with_expressions(with_modes(model, 3))
    z = np.zeros(len(posed.modes))
    z[1], z[posed.posed.start + model.expressions.names.index("jawOpen")] = 0.7, 0.4
    np.testing.assert_allclose(
        posed.vertices(z, "p99"), model.posed_vertices(z[:3], {"jawOpen": 0.4}, "p99"), atol=1e-4
    )


def test_weights_are_read_in_either_manner_and_every_fault_is_named() -> None:
    names = ("mouthSmile_L", "jawOpen")
    assert weights_from_text(["mouthSmileLeft=0.4", "jawOpen=1"], names) == {"mouthSmile_L": 0.4, "jawOpen": 1.0}
    with pytest.raises(InputError) as fault:
        weights_from_text(["jawOpens=0.2", "jawOpen=2", "jawOpen"], names)
    assert len(fault.value.faults) == 3
    assert "near are jawOpen" in fault.value.faults[0].text


def test_what_moves_no_skin_is_no_expression_and_blinks_close_their_own_eye() -> None:
    shapes = np.zeros((2, 5, 3), np.float32)
    shapes[1, 2, 0] = 3.0
    assert visible(Expressions(("tongueOut", "jawOpen"), shapes)).names == ("jawOpen",)
    assert closed_lids({"eyeBlink_L": 0.7, "jawOpen": 1.0}) == {"right": 0.0, "left": 0.7}


NAMES = ["sil", "PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "I", "O", "U"]
PAGE = Path(__file__).parents[3] / "docs" / "templates.md"


def test_the_fifteen_are_mixtures_of_apples_shapes() -> None:
    assert list(VISEMES) == [f"viseme_{name}" for name in NAMES]
    for mixture in VISEMES.values():
        assert set(mixture) <= set(ARKIT)
        assert all(0.0 < weight <= 1.0 for weight in mixture.values())
    assert not VISEMES["viseme_sil"]
    # What a model lacks is left out.
    shapes = {"jawOpen": np.full((4, 3), 2.0)}
    np.testing.assert_allclose(mixed(shapes, VISEMES["viseme_TH"]), 0.24)


def test_the_page_states_every_weight() -> None:
    rows = dict(re.findall(r"^\| `viseme_(\w+)` \| .*? \| (.*?) \|$", PAGE.read_text(), flags=re.MULTILINE))
    assert list(rows) == NAMES
    for name, text in rows.items():
        stated: dict[str, float] = {}
        for shape, weight in re.findall(r"(\w+) (0\.\d+)", text):
            sides = [shape] if shape in ARKIT else [f"{shape}Left", f"{shape}Right"]
            stated |= dict.fromkeys(sides, float(weight))
        assert stated == VISEMES[f"viseme_{name}"], name
