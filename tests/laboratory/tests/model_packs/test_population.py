"""The sampled population: weights that are shares, controls that are pairs, and draws that the seed alone decides."""

import numpy as np
import pytest

from tests.laboratory.model_packs.makehuman import Base
from tests.laboratory.model_packs.population import (
    RACES,
    SUBJECTS,
    Sampling,
    Targets,
    controls,
    local_weights,
    macro_weights,
    sample_shapes,
)

SIDES = ["l-ear-up", "l-ear-down", "r-ear-up", "r-ear-down"]


@pytest.mark.parametrize("male", [True, False])
def test_macro_weights_are_shares_of_one_adult(male: bool) -> None:
    maleness = []
    for seed in range(40):
        weights = macro_weights(np.random.default_rng(seed), male, Sampling())
        by_race = {name: w for name, w in weights.items() if name.split("-")[0] in RACES}
        universal = {name: w for name, w in weights.items() if name.startswith("universal-")}
        assert len(by_race) + len(universal) == len(weights)
        assert min(weights.values()) > 0
        for shares in (by_race, universal):
            assert sum(shares.values()) == pytest.approx(1.0)
            maleness.append(sum(w for name, w in shares.items() if name.split("-")[1] == "male"))
        assert maleness[-1] == pytest.approx(maleness[-2])  # the same sex in both
    # Beta(6, 1.2) has a mean of 0.83; that of 40 draws is within 0.08 of it, four times 0.13 / sqrt(40).
    assert np.mean(maleness) == pytest.approx(0.83 if male else 0.17, abs=0.08)


def test_opposite_targets_are_one_control_and_what_is_no_face_is_left_out() -> None:
    names = ["nose-width-decr", "nose-width-incr", "nose-hump", "chin-cleft-incr", "asymm-breast-1", "head-age-incr"]
    assert controls(names) == {
        "nose-width": ("nose-width-decr", "nose-width-incr"),
        "nose-hump": (None, "nose-hump"),
        "chin-cleft-incr": (None, "chin-cleft-incr"),
    }


def test_left_and_right_share_most_of_their_value() -> None:
    """The correlation of two that share sqrt(1 - s^2) of a draw and add s of their own is 1 - s^2."""
    sampling, rng = Sampling(sidedness=0.5, clip=10.0), np.random.default_rng(0)
    values = []
    for _ in range(4000):
        weights = local_weights(rng, SIDES, 0.3, sampling)
        values.append([weights.get(f"{s}-ear-up", 0.0) - weights.get(f"{s}-ear-down", 0.0) for s in "lr"])
    left, right = np.array(values).T
    assert np.std(left) == pytest.approx(0.3, rel=0.05)
    assert np.corrcoef(left, right)[0, 1] == pytest.approx(0.75, abs=0.03)
    # No weight is beyond the clip, and none is negative.
    sampling, rng = Sampling(clip=1.0, sidedness=0.0), np.random.default_rng(1)
    drawn = [w for _ in range(200) for w in local_weights(rng, [*SIDES, "nose-hump"], 0.3, sampling).values()]
    assert max(drawn) == pytest.approx(0.3)
    assert min(drawn) >= 0


def test_a_subject_depends_on_the_seed_and_its_number_alone() -> None:
    base = Base(np.zeros((3, 3)), np.zeros((0, 4), np.int32))
    rng = np.random.default_rng(2)
    macro = {f"{race}-male-young": rng.normal(size=(3, 3)) for race in RACES}
    ears = {name: rng.normal(size=(3, 3)) for name in SIDES}
    targets = Targets(macro, {folder: ears if folder == "ears" else {} for folder in Sampling().local})
    shapes = sample_shapes(base, targets, Sampling())
    assert shapes.shape == (SUBJECTS["total"], 3, 3)
    np.testing.assert_array_equal(shapes, sample_shapes(base, targets, Sampling()))
    assert (sample_shapes(base, targets, Sampling(seed=1)) != shapes).any(axis=(1, 2)).all()
    # Males come first; the only macro targets here are of males, of which women hold a sixth.
    no_local: dict[str, dict[str, np.ndarray]] = {folder: {} for folder in Sampling().local}
    size = np.abs(sample_shapes(base, Targets(macro, no_local), Sampling())).sum(axis=(1, 2))
    assert np.median(size[: SUBJECTS["male"]]) > 2 * np.median(size[SUBJECTS["male"] :])
