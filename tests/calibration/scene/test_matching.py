"""Features and matches: within shots only, and every picture that cannot be used named."""

from pathlib import Path

import numpy as np
import pytest

from calibration.scene.matching import match_photographs
from calibration.scene.photographs import find_photographs
from rig.errors import InputError
from rig.formats.pictures.images import write_image
from rig.progress import discard_progress
from tests.support.textured_wedge import photograph, wedge_rig


def test_pictures_of_different_shots_are_not_matched(tmp_path: Path) -> None:
    """Three cameras see one and the same picture, the third in another shot: it shares no moment with the others."""
    picture = photograph(wedge_rig()["cam02"])
    for camera, shot in (("a", "1"), ("b", "1"), ("c", "2")):
        write_image(tmp_path / "photos" / camera / f"{shot}.png", picture)
    (tmp_path / "scratch").mkdir()
    found = match_photographs(
        find_photographs(tmp_path / "photos"), tmp_path / "scratch", one_lens=False, report=discard_progress
    )
    assert found.matched["a", "b"] > 500
    assert not found.matched.get(("a", "c"), 0)
    assert not found.matched.get(("b", "c"), 0)
    assert found.matched_keypoints == 2 * found.matched["a", "b"]
    assert not found.one_lens


def test_shots_of_two_sizes_are_named(tmp_path: Path) -> None:
    for camera in "abc":
        write_image(tmp_path / "photos" / camera / "1.png", np.zeros((40, 60), np.uint8))
    write_image(tmp_path / "photos" / "b" / "2.png", np.zeros((60, 40), np.uint8))
    with pytest.raises(InputError, match=r"b/2 is 40 x 60 pixels, but the other shots of its camera are 60"):
        match_photographs(find_photographs(tmp_path / "photos"), tmp_path, one_lens=None, report=discard_progress)
