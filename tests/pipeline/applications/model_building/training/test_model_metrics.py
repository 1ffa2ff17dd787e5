"""Figures of a model's own random heads."""

from pipeline.head_model.model import load_model, with_modes
from tests.support.model_draws import of_draws


def test_draws_of_two_modes_are_spanned_by_two_modes_and_lie_closer_the_more_there_are() -> None:
    """Heads in a plane: the others' first two components hold each of them, to single precision."""
    plane = with_modes(load_model(), 2)
    few, many = (of_draws(plane, heads=count, used=2, draws=40) for count in (10, 80))
    assert few["generalisation_mm"] < 1e-3
    assert 0 < many["specificity_mm"] < few["specificity_mm"]
