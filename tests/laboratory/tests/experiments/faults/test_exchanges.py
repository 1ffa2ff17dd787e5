"""Exchanges planted among masks of two heads, one of them with hair: named, and filed back."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments.faults.exchanges import KINDS, _planted, exchanges
from tests.laboratory.experiments.records import Bench


@pytest.mark.gl
@pytest.mark.slow
def test_pairs_triples_and_duplicates_are_named_and_repaired(renderer):
    found = exchanges(load_model(), renderer=renderer, bench=Bench(), subjects=2)["figures"]
    assert [found[f"{kind}_named_share"] for kind in KINDS] == [1.0, 1.0, 1.0]
    assert (found["pair_repaired_share"], found["triple_repaired_share"]) == (1.0, 1.0)
    assert found["good_called_exchanged"] == 0


@pytest.mark.parametrize(("kind", "moved"), list(zip(KINDS, (2, 3, 1), strict=True)))
def test_an_exchange_moves_as_many_files_as_it_says(kind, moved):
    filed = _planted(kind, default_layout(), np.random.default_rng(0))
    assert len(filed) == moved
    assert all(name != picture for name, picture in filed.items())
    assert (sorted(filed) == sorted(filed.values())) == (kind != "duplicate")
