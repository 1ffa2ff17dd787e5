"""`make test-shapes` holds every call to its annotated types and shapes: in the product, by each kind of callable."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float

from tests.support.shape_checks import ROOT, checked, checked_modules

Row = Float[np.ndarray, " n"]


PLANTED = """
import numpy as np
from tests.support.shape_checks import check_imports, checked_modules
check_imports(checked_modules())
from rig.geometry import RigidTransform
for wrong in (
    lambda: RigidTransform(np.zeros((2, 2)), np.zeros(3)),
    lambda: RigidTransform(np.eye(3), np.zeros(3)) @ "other",
):
    try:
        wrong()
    except Exception as violation:
        print(type(violation).__name__, "parameter rotation=" in str(violation), "parameter other=" in str(violation))
"""


def test_a_wrong_shape_is_refused() -> None:
    """In a process of its own: this one has imported the product already, mostly without checks."""
    done = subprocess.run([sys.executable, "-c", PLANTED], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.stdout.split("\n") == [
        "BeartypeCallHintParamViolation True False",
        "BeartypeCallHintParamViolation False True",
        "",
    ], done.stderr


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


def product_files() -> list[Path]:
    return [path for room in ("rig", "pipeline", "calibration") for path in (ROOT / room).rglob("*.py")]


def test_only_compiled_loops_are_left_out() -> None:
    """A module was left out where its text held the word njit, so that wrappers of loops went unchecked."""
    plain = (path for path in product_files() if path.stem != "__init__" and not path.stem.endswith("_kernels"))
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in plain}
    assert names == set(checked_modules())


def test_loops_are_compiled_in_modules_of_their_own() -> None:
    """There, in ``*_kernels.py``, annotations are not checked; beside other functions they would be wrapped."""
    compiled = [path for path in product_files() if re.search(r"^\s*@njit\b", path.read_text("utf-8"), re.MULTILINE)]
    assert len(compiled) > 15
    assert [path for path in compiled if not path.stem.endswith("_kernels")] == []
