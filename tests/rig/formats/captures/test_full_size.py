"""Pictures are read once more at the size of their files."""

from pathlib import Path

import numpy as np
import pytest

from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.errors import InputError
from rig.formats.captures.capture_folder import read_capture, write_capture
from rig.formats.captures.full_size import full_size_reader
from rig.geometry import look_at
from rig.rig import Rig


def test_a_reduced_picture_is_read_at_full_size(tmp_path: Path) -> None:
    lens = Intrinsics(160, 120, 300.0, 300.0, 79.5, 59.5)
    places = {"a": (0.0, 0.0, 900.0), "b": (300.0, 0.0, 850.0), "c": (-300.0, 0.0, 850.0)}
    zero, up = np.zeros(3), np.array([0.0, 1.0, 0.0])
    rig = Rig(tuple(Camera(name, lens, look_at(np.array(at), zero, up)) for name, at in places.items()))
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 255, (120, 160, 3), np.uint8) for name in rig.names}
    masks = {name: np.pad(np.ones((60, 80), bool), ((30, 30), (40, 40))) for name in rig.names}
    write_capture(tmp_path, Capture(images, masks=masks), rig)
    reduced, _ = read_capture(tmp_path, pixels_most=5000)
    assert reduced.images["b"].shape == (60, 80, 3)
    read = full_size_reader(tmp_path, rig)
    np.testing.assert_array_equal(read("b"), images["b"])
    (tmp_path / "images" / "b.png").unlink()
    with pytest.raises(InputError):
        read("b")
