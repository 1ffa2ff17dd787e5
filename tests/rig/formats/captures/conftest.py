"""The folder of a small capture, for every test of this room."""

from pathlib import Path

import pytest

from rig.formats.captures.capture_folder import write_capture
from tests.support.small_captures import small_capture, small_rig


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_capture(tmp_path / "shot", small_capture(), small_rig())
    return tmp_path / "shot"
