"""Polygons that are drawn by hand, filled."""

import json
from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.captures.outlines_json import OUTLINES_FORMAT, read_outlines
from tests.support.textured_wedge import wedge_rig


def written(folder: Path, outlines: object, kind: str = OUTLINES_FORMAT) -> Path:
    path = folder / "outlines.json"
    path.write_text(json.dumps({"format": kind, "outlines": outlines}))
    return path


def test_a_square_with_a_hole_has_its_area(tmp_path: Path) -> None:
    square, hole = [[100, 50], [299, 50], [299, 249], [100, 249]], [[150, 100], [199, 100], [199, 149], [150, 149]]
    found = read_outlines(written(tmp_path, {"cam00": [square, hole], "elsewhere": [square]}), wedge_rig())
    assert list(found) == ["cam00"]
    mask = found["cam00"]
    assert mask.shape == (300, 400)
    assert mask[60, 110]
    assert not mask[60, 90]
    # Areas of 200 x 200 less 50 x 50, to half a pixel along 800 and 200 px of outline.
    assert abs(np.count_nonzero(mask) - (200**2 - 50**2)) < 500


@pytest.mark.parametrize(
    ("outlines", "kind", "text"),
    [
        ({}, "eigenhead-cameras/1", "format"),
        ([1, 2], OUTLINES_FORMAT, "cannot be read"),
        ({"cam00": [[[1, 2], [3, "x"]]]}, OUTLINES_FORMAT, "cannot be read"),
        ({"cam00": [[[1, 2], [3, 1e9], [3, 4]]]}, OUTLINES_FORMAT, "cam00"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, outlines: object, kind: str, text: str) -> None:
    with pytest.raises(InputError, match=text):
        read_outlines(written(tmp_path, outlines, kind), wedge_rig())
