"""Floors: zero where the truth lies in the span, as on the shared scans where it does not."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.errors import InputError
from tests.laboratory.experiments.paper.span import floor, random_draws, read_truth, run, weighted_quantile
from tests.support.shared_data import shared


def test_weighted_quantile_is_the_plain_one_for_equal_weights() -> None:
    values = np.random.default_rng(0).permutation(101).astype(float)
    assert weighted_quantile(values, np.ones(101), 0.5) == 50
    assert weighted_quantile(np.array([1.0, 2.0]), np.array([1.0, 9.0]), 0.5) == 2


def test_a_folder_without_truth_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match="face_mask"):
        read_truth(tmp_path)


@pytest.mark.slow
def test_a_head_of_the_model_itself_has_almost_no_floor() -> None:
    """All modes: what remains is the prior's pull, 1.5 mm a sigma per cm2 over some 400 cm2 of face."""
    model = load_model()
    row = floor("default", model, random_draws(model, 1)[0])
    assert row["median_mm"] < 0.2


@pytest.mark.slow
def test_the_defaults_floor_on_the_real_scan() -> None:
    figures = run({"default": load_model()}, [read_truth(shared("data/captures/scan-a.truth"))])["figures"]
    for modes in ("60", "all"):
        assert figures[f"default_{modes}_scan-a_median_mm"] < 0.9
        assert figures[f"default_{modes}_scan-a_largest_sigma"] < 3.0
