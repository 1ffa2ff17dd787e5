"""The fast tests hold every call to its annotated types and shapes: in the product, and by each kind of callable."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float

from rig.geometry import RigidTransform
from tests.support.shape_checks import checked

Row = Float[np.ndarray, " n"]


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(BeartypeCallHintViolation, match="rotation"):
        RigidTransform(np.zeros((2, 2)), np.zeros(3))
    with pytest.raises(BeartypeCallHintViolation, match="other"):
        _ = RigidTransform(np.eye(3), np.zeros(3)) @ "other"  # pyright: ignore[reportOperatorIssue]


@checked
@dataclass(frozen=True)
class Pair:
    one: Row
    other: Row

    @property
    @checked
    def both(self) -> Float[np.ndarray, "2 n"]:
        return np.stack([self.one, self.other])[:, :2]

    @staticmethod
    @checked
    def of(rows: list[Row]) -> "Pair":
        return Pair(rows[0], rows[1])


@checked
def joined(one: Row, other: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n+m"]:
    return np.concatenate([one, other])[: 3 * len(one)]


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: Pair(np.zeros(2), np.zeros(3)),
        lambda: Pair(np.zeros(2, int), np.zeros(2)),
        lambda: Pair.of([np.zeros((2, 2)), np.zeros((2, 2))]),
        lambda: joined(np.zeros(1), np.zeros(3)),
    ],
    ids=["two sizes of one letter", "of whole numbers", "in a list", "the answer"],
)
def test_a_letter_means_one_size_in_one_call(wrong: Callable[[], object]) -> None:
    with pytest.raises(BeartypeCallHintViolation):
        wrong()


def test_each_call_has_letters_of_its_own() -> None:
    assert Pair(np.zeros(2), np.zeros(2)).both.shape == (2, 2)
    assert len(joined(np.zeros(2), joined(np.zeros(3), np.zeros(1)))) == 6
    assert Pair.of([np.zeros(1), np.zeros(1)]).one.shape == (1,)
