"""Draws of expressions, and the correlation that the experiment quotes."""

import numpy as np
import pytest

from pipeline.eigenheads.model import load_model
from pipeline.experiments.expressions import JAW, WEIGHTS, _correlation, drawn_weights


def test_draws_are_faces_that_people_make() -> None:
    names, smiles = load_model().expressions.names, 0
    for seed in range(60):
        weights = drawn_weights(np.random.default_rng(seed), names)
        assert all(0.0 < weight <= 1.0 for weight in weights.values())
        assert weights.get("jawOpen", 0.0) <= JAW * WEIGHTS[1]
        assert weights.get("mouthClose", 0.0) <= 0.5 * weights.get("jawOpen", 0.0)
        sides = [weights.get(f"mouthSmile{side}", 0.0) for side in ("Left", "Right")]
        smiles += min(sides) > 0.0
        assert seed < 0 or min(sides) == 0.0 or abs(sides[0] - sides[1]) < 0.5
    assert 22 < smiles < 50  # 60 of 0.6, within four deviations


def test_the_correlation_counts_what_was_found_and_is_not_there() -> None:
    def row(truth: dict[str, float], told: dict[str, float]) -> dict[str, object]:
        return {"model": "m", "kind": "posed", "truth": truth, "after": {"weights": told}}

    exact = row({"a": 0.2, "b": 0.8}, {"a": 0.2, "b": 0.8})
    assert _correlation([exact], "m") == pytest.approx(1.0)
    wrong = row({"a": 0.2, "b": 0.8}, {"a": 0.2, "b": 0.8, "c": 0.9})
    assert _correlation([wrong], "m") < 0.5
