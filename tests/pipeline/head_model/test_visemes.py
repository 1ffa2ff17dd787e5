"""The shapes of speech as mixtures, and the table that states them."""

import re
from pathlib import Path

import numpy as np

from pipeline.head_model.expressions import ARKIT, VISEMES, mixed

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
