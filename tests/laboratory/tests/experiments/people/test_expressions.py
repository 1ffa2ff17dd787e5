"""The correlation that the experiment quotes."""

import numpy as np
import pytest

from tests.laboratory.experiments.people.expressions import _weights


def test_weights_are_judged_over_the_true_ones_over_all_and_each() -> None:
    first = {"model": "m", "kind": "posed", "truth": {"a": 0.2, "b": 0.8}, "weights": {"a": 0.3, "b": 0.8}}
    other = {"model": "m", "kind": "posed", "truth": {"a": 0.4}, "weights": {"c": 0.5}}
    found = _weights([first, other], "m")
    assert found["weights_off"] == pytest.approx(0.5 / 3.0)
    assert found["weights_told_of_none"] == pytest.approx(0.25)
    assert found["weights_correlation_true"] == pytest.approx(np.corrcoef([0.2, 0.8, 0.4], [0.3, 0.8, 0.0])[0, 1])
    assert found["weights_correlation_all"] < found["weights_correlation_true"]
