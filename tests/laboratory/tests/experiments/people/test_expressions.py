"""The correlation that the experiment quotes."""

import numpy as np
import pytest

from tests.laboratory.experiments.people.expressions import _correlation, _is_no_eye, _weights


def test_the_correlation_counts_what_was_found_and_is_not_there() -> None:
    def row(truth: dict[str, float], weights: dict[str, float]) -> dict[str, object]:
        return {"model": "m", "kind": "posed", "truth": truth, "after": {"weights": weights}}

    exact = row({"a": 0.2, "b": 0.8}, {"a": 0.2, "b": 0.8})
    assert _correlation([exact], "m") == pytest.approx(1.0)
    wrong = row({"a": 0.2, "b": 0.8}, {"a": 0.2, "b": 0.8, "c": 0.9})
    assert _correlation([wrong], "m") < 0.5
    lids = row({"a": 0.2, "eyebrows-up": 0.8, "eyeBlink_R": 0.7}, {"a": 0.2, "eyebrows-up": 0.8, "eye-left-slit": 0.5})
    assert _correlation([lids], "m") < 0.5
    assert _correlation([lids], "m", _is_no_eye) == pytest.approx(1.0)


def test_weights_are_judged_over_the_true_ones_over_all_and_each() -> None:
    first = {"model": "m", "kind": "posed", "truth": {"a": 0.2, "b": 0.8}, "after": {"weights": {"a": 0.3, "b": 0.8}}}
    other = {"model": "m", "kind": "posed", "truth": {"a": 0.4}, "after": {"weights": {"c": 0.5}}}
    found = _weights([first, other], "m")
    assert found["off_a"] == pytest.approx(0.25)
    assert found["off_b"] == 0.0
    assert "off_c" not in found  # nobody has it
    assert found["weights_off"] == pytest.approx(0.5 / 3.0)
    assert found["weights_told_of_none"] == pytest.approx(0.25)
    assert found["weights_correlation_true"] == pytest.approx(np.corrcoef([0.2, 0.8, 0.4], [0.3, 0.8, 0.0])[0, 1])
    assert found["weights_correlation_all"] < found["weights_correlation_true"]
