"""Pictures are read once more at the size of their files."""

from pathlib import Path

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.captures.full_size import full_size_reader
from tests.support.small_captures import small_capture, small_rig


def test_a_reduced_picture_is_read_at_full_size(tmp_path: Path) -> None:
    write_capture(tmp_path, whole := small_capture(), small_rig())
    reduced, _ = read_capture(tmp_path, pixels_most=800)
    assert reduced.images["b"].shape == (24, 32, 3)
    read = full_size_reader(tmp_path, small_rig())
    np.testing.assert_array_equal(read("b"), whole.images["b"])
    (tmp_path / "images" / "b.png").unlink()
    with pytest.raises(InputError):
        read("b")
