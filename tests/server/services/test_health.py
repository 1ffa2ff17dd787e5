"""What readiness says of the disk."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from server.services.health import _disk


@pytest.mark.parametrize(
    ("free", "writable", "code"),
    [(3000, True, "disk-free"), (1000, True, "disk-too-full"), (3000, False, "disk-unwritable")],
)
def test_a_disk_has_room_and_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, writable: bool, code: str
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: writable)  # root may write what the mode forbids
    settings = SimpleNamespace(data=tmp_path, free_bytes=2000)
    service: Any = SimpleNamespace(store=SimpleNamespace(free_bytes=lambda: free), settings=settings)
    found = _disk(service)
    assert (found.ok, found.detail.code) == (code == "disk-free", code)
