"""Faces for the pages: found in a child by the pixels of the files, once, and within a time."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.head_model.landmarks import SEVEN_POINTS
from rig.progress import Progress
from server.console import media
from server.console import media as module
from server.console.media import found_faces
from server.errors import Conflict, Unavailable
from server.services.keys import LOCAL, Caller
from server.storage.records import CameraSize
from server.storage.store import Store
from server.tasks.child import ChildProcessPool, WorkerContext
from tests.support.drawn_studio import LENS, drawn_studio, write_drawn_capture
from tests.support.stored_captures import stored_files


@pytest.fixture(scope="module")
def children() -> Iterator[ChildProcessPool]:
    pool = ChildProcessPool(1)
    yield pool
    pool.close()


def service_with(children: ChildProcessPool, data: Path, *, board: bool = False) -> tuple:
    """A service that has one capture, and the capture's id."""
    store = Store(data)
    sizes = tuple(CameraSize(name, LENS.width, LENS.height) for name in drawn_studio().names)
    files = write_drawn_capture(data / "drawn")
    capture = stored_files(store, files, cameras=sizes, front="cam0", board=board)
    return SimpleNamespace(store=store, children=children), capture


def test_they_are_found_once_and_kept_with_the_capture(children: ChildProcessPool, tmp_path: Path) -> None:
    service, capture = service_with(children, tmp_path)
    found = found_faces(service, capture)
    subject = {name for name, faces in found["faces"].items() if any(face["is_subject"] for face in faces)}
    assert subject == {"cam0", "cam1", "cam2", "cam3", "cam4"}
    face = found["faces"]["cam0"][0]
    points = np.array(face["points"])
    assert points.shape == (468, 2)
    assert face["box_px"] == [*points.min(axis=0), *points.max(axis=0)]
    assert np.hypot(*(points.mean(axis=0) - (159.5, 119.5))) < 20.0
    assert found["suggested"].keys() == set(SEVEN_POINTS)
    answer = media.faces((service, Caller(LOCAL, frozenset({"read"}))), capture)
    assert json.loads(bytes(answer.body)) == found["faces"]
    assert "immutable" in answer.headers["Cache-Control"]
    (kept,) = (service.store.cache_of(capture) / "faces").iterdir()
    kept.write_text(json.dumps(found | {"suggested": {}}))
    assert found_faces(service, capture)["suggested"] == {}, "the second time they come from there"
    service.store.remove_capture(capture)
    assert not kept.exists()


def test_a_shot_of_the_board_has_none(children: ChildProcessPool, tmp_path: Path) -> None:
    service, capture = service_with(children, tmp_path, board=True)
    with pytest.raises(Conflict):
        found_faces(service, capture)


def test_who_waits_long_is_told(children: ChildProcessPool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service, capture = service_with(children, tmp_path)
    monkeypatch.setattr(module, "PATIENCE_S", 0.5)
    monkeypatch.setattr(module, "find_capture_faces", endless)
    with pytest.raises(Unavailable) as refusal:
        found_faces(service, capture)
    assert refusal.value.message.code == "faces-slow"
    assert not [*(service.store.cache_of(capture) / "faces").iterdir()]


def endless(context: WorkerContext, report: Progress, *, capture: str, images: dict[str, str]) -> None:
    """Work that does not listen, and takes longer than a test may."""
    time.sleep(600.0)
