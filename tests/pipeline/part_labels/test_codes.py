"""Parts have one set of numbers in the whole program: that of written files, and one way from a channel to it."""

import ast
from pathlib import Path

import numpy as np
import pytest

from pipeline.part_labels.codes import CHANNELS, Part, codes_from_channels

ROOT = Path(__file__).resolve().parents[3]


def test_the_codes_are_those_of_written_files_and_channels_turn_into_them() -> None:
    """docs/capture-format.md and every bust.ply that was ever written count so."""
    assert [(part.value, part.name) for part in Part] == [(0, "UNSEEN"), (1, "SKIN"), (2, "HAIR"), (3, "CLOTHES")]
    np.testing.assert_array_equal(codes_from_channels(np.array([2, 0, 1, 0])), [3, 1, 2, 1])
    assert [CHANNELS[part.channel] for part in CHANNELS] == list(CHANNELS)
    with pytest.raises(ValueError, match="not in tuple"):
        _ = Part.UNSEEN.channel


def test_no_other_module_numbers_the_parts() -> None:
    """A second enumeration once counted from another number, and both were called SKIN, HAIR and CLOTHES."""
    names = {part.name for part in Part}
    numbered = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "pipeline").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Assign) and names & _numbered(node)
    }
    assert numbered == {"pipeline/part_labels/codes.py"}


def _numbered(node: ast.Assign) -> set[str]:
    """Returns the names that an assignment of plain numbers binds."""
    values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
    if not all(isinstance(value, ast.Constant) and isinstance(value.value, int) for value in values):
        return set()
    return {name.id for target in node.targets for name in ast.walk(target) if isinstance(name, ast.Name)}
