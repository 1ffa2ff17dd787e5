"""Faults of captures that the door names without a service around it."""

from pathlib import Path

import pytest

from rig.errors import InputError
from server.storage.records import CaptureContent
from server.tasks.ingest import check_capture
from tests.server.http.test_hostile import SPOILT
from tests.support.services import small_capture

PIXELS_MOST = 100_000_000


def checked(folder: Path) -> CaptureContent:
    return check_capture(folder, PIXELS_MOST, lambda stage, share: None)


@pytest.mark.parametrize("case", SPOILT)
def test_every_spoilt_capture_is_refused_with_its_fault(tmp_path: Path, case: str) -> None:
    spoil, word = SPOILT[case]
    folder = small_capture(tmp_path / "capture")
    spoil(folder)
    with pytest.raises(InputError) as refusal:
        checked(folder)
    assert word in " ".join(refusal.value.faults)


def test_faults_of_cameras_files_and_features_are_told_at_once(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    for case in ("every camera at one place", "an image without a camera", "features of a third eye"):
        SPOILT[case][0](folder)
    with pytest.raises(InputError) as refusal:
        checked(folder)
    for word in ("at one place", "images/foo.png has no camera", "'third_eye' is no landmark"):
        assert any(word in fault for fault in refusal.value.faults)


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    path = folder / "cameras.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert [camera.name for camera in checked(folder).cameras] == ["cam00", "cam01", "cam02"]
