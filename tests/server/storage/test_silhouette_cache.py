"""Silhouettes come back from the disk as they were found, and only where nothing that they follow from has changed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.imaging.silhouette import Silhouette
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.rig import Rig
from server.storage.silhouette_cache import segment_once
from tests.support.services import small_capture


@pytest.fixture
def shot(tmp_path: Path) -> tuple[Capture, Rig]:
    """Small views of a disc before noise; one view shows nothing."""
    capture, rig = read_capture(small_capture(tmp_path / "capture", size=96))
    rows, columns = np.mgrid[:96, :96]
    disc = np.hypot(rows - 50, columns - 44) < 30
    images = {
        name: np.where(disc[:, :, None], 255 - plates[0], plates[0]).astype(np.uint8)
        for name, plates in capture.backgrounds.items()
    }
    images["cam02"] = capture.backgrounds["cam02"][0]
    return replace(capture, images=images), rig


def looked(folder: Path, capture: Capture, rig: Rig) -> tuple[dict, bool]:
    """What was found, and whether it had to be made: only then is there progress to report."""
    shares: list[float] = []
    found = segment_once(folder, capture, rig, report=lambda stage, share: shares.append(share))
    return found, len(shares) > 1


def assert_same(first: dict[str, Silhouette], second: dict[str, Silhouette]) -> None:
    assert list(first) == list(second)
    for name, silhouette in first.items():
        assert np.array_equal(silhouette.mask, second[name].mask)
        assert silhouette.distance.tobytes() == second[name].distance.tobytes()
        assert (silhouette.mask.dtype, silhouette.distance.dtype) == (
            second[name].mask.dtype,
            second[name].distance.dtype,
        )
        assert silhouette.quality == second[name].quality


def test_what_comes_back_is_bit_for_bit_what_was_found(shot: tuple[Capture, Rig], tmp_path: Path) -> None:
    found, made = looked(tmp_path, *shot)
    again, made_again = looked(tmp_path, *shot)
    assert (made, made_again) == (True, False)
    assert_same(found, again)
    assert found["cam00"].mask.any()
    assert not found["cam02"].quality.usable


def test_another_image_is_another_silhouette_and_features_are_not(shot: tuple[Capture, Rig], tmp_path: Path) -> None:
    capture, rig = shot
    looked(tmp_path, capture, rig)
    picked = replace(capture, digests={**capture.digests, "features.json": "0" * 64})
    assert not looked(tmp_path, picked, rig)[1]
    for changed in (name for name in capture.digests if name != "features.json"):
        other = replace(capture, digests={**capture.digests, changed: "0" * 64})
        assert looked(tmp_path, other, rig)[1], changed


@pytest.mark.parametrize("where", [0, 200, -30])
def test_a_damaged_file_is_made_anew(shot: tuple[Capture, Rig], tmp_path: Path, where: int) -> None:
    found, _ = looked(tmp_path, *shot)
    (file,) = tmp_path.glob("*.silhouettes")
    data = bytearray(file.read_bytes())
    data[where] ^= 0x55
    file.write_bytes(data)
    again, made = looked(tmp_path, *shot)
    assert made
    assert_same(found, again)
    assert not looked(tmp_path, *shot)[1]


def test_a_cache_that_cannot_be_written_is_done_without(shot: tuple[Capture, Rig], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    found, made = looked(tmp_path / "file", *shot)
    assert made
    assert set(found) == set(shot[1].names)
