"""Calibrations as a service knows them, with an engine that only remembers: states, results, what is in use."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.errors import InputError
from rig.messages.message import texts_of
from server.errors import Conflict, NotFound
from server.services.calibrations import Calibrations
from server.settings import ServiceSettings
from server.storage.database import open_database
from server.storage.events import EventLog
from server.storage.records import CameraSize, EventDocument
from server.storage.store import Store, new_id
from tests.support.stored_captures import stored_files

BOARD = {"kind": "checkerboard", "columns": 9, "rows": 6, "square_mm": 25.0}


@dataclass
class Engine:
    """What ``Calibrations`` calls of DBOSClient."""

    rows: dict[str, SimpleNamespace] = field(default_factory=dict)

    def enqueue(self, options: Mapping[str, Any], *_: Any) -> None:
        identity = options["workflow_id"]
        self.rows[identity] = SimpleNamespace(status="ENQUEUED", output=None, error=None, workflow_id=identity)

    def list_workflows(self, *, workflow_ids: list[str], name: str) -> list[SimpleNamespace]:
        assert name == "calibrate"
        return [self.rows[identity] for identity in workflow_ids if identity in self.rows]

    def delete_workflow(self, identity: str) -> None:
        del self.rows[identity]


@pytest.fixture
def engine() -> Engine:
    return Engine()


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "data")


@pytest.fixture
def calibrations(store: Store, engine: Engine) -> Calibrations:
    events = EventLog(open_database(ServiceSettings(data=store.data)))
    return Calibrations(store, engine, "queue", events)  # pyright: ignore[reportArgumentType]


def board_shot(store: Store, text: str) -> str:
    """A capture of two pictures in the store."""
    sizes = tuple(CameraSize(name, 4, 3) for name in ("cam00", "cam01"))
    with store.incoming() as files:
        (files / "images").mkdir()
        for size in sizes:
            (files / "images" / f"{size.name}.png").write_text(f"{text} {size.name}")
        return stored_files(store, files, source="rig", cameras=sizes, board=True)


def finish(store: Store, engine: Engine, identity: str, text: str = "{}") -> str:
    """As the worker does it; the sha256 of its cameras.json."""
    path = store.folder("calibrations", identity) / "result" / "cameras.json"
    path.parent.mkdir()
    path.write_text(text)
    digest = hashlib.sha256(text.encode()).hexdigest()
    outcome = {"figures": {"rms_px": 0.2}, "checks": [], "warnings": ["w"], "front": "cam00", "sha256": digest}
    engine.rows[identity].status, engine.rows[identity].output = "SUCCESS", outcome
    return digest


def test_shots_of_the_board_become_one_folder_a_camera(calibrations: Calibrations, store: Store) -> None:
    shots = [board_shot(store, "first"), board_shot(store, "second")]
    made = calibrations.add_shots(BOARD, shots, "after the move")
    assert (made.state, made.label, made.source) == ("queued", "after the move", "rig")
    assert made.pictures == {"cam00": 2, "cam01": 2}
    folder = store.folder("calibrations", made.id)
    pictures = {path.relative_to(folder / "images").as_posix(): path.read_text() for path in folder.glob("images/*/*")}
    assert pictures == {
        "cam00/shot000.png": "first cam00",
        "cam00/shot001.png": "second cam00",
        "cam01/shot000.png": "first cam01",
        "cam01/shot001.png": "second cam01",
    }
    assert (folder / "board.toml").is_file()
    assert list((store.data / "incoming").iterdir()) == []


def test_a_board_or_shot_that_is_none_queues_nothing(calibrations: Calibrations, store: Store, engine: Engine) -> None:
    with pytest.raises(NotFound):
        calibrations.add_shots(BOARD, [board_shot(store, "one"), new_id()], "")
    with pytest.raises(InputError, match="square_mm"):
        calibrations.add_shots(BOARD | {"square_mm": -1.0}, [board_shot(store, "one")], "")
    assert calibrations.find() == []
    assert engine.rows == {}
    assert list((store.data / "incoming").iterdir()) == []


def test_a_result_is_there_once_it_succeeded(calibrations: Calibrations, store: Store, engine: Engine) -> None:
    made = calibrations.add_shots(BOARD, [board_shot(store, "one")], "")
    with pytest.raises(Conflict, match="queued"):
        calibrations.result(made.id, "cameras.json")
    engine.rows[made.id].status = "PENDING"
    with pytest.raises(Conflict, match="wait"):
        calibrations.remove(made.id)
    digest = finish(store, engine, made.id)
    found = calibrations.get(made.id)
    assert (found.state, found.figures, found.front) == ("succeeded", {"rms_px": 0.2}, "cam00")
    assert texts_of(found.warnings) == ["w"]  # of a version whose warnings were texts
    assert calibrations.file(made.id, "cameras.json").sha256 == digest


def test_a_damaged_one_holds_up_no_list(calibrations: Calibrations, store: Store) -> None:
    damaged, whole = (calibrations.add_shots(BOARD, [board_shot(store, "1")], "").id for _ in range(2))
    (store.folder("calibrations", damaged) / "record.json").write_text("[]")
    assert [found.id for found in calibrations.find()] == [whole]
    assert len(store.list_quarantined()) == 1


def test_one_is_in_use_until_another_is(calibrations: Calibrations, store: Store, engine: Engine) -> None:
    first, second = (calibrations.add_shots(BOARD, [board_shot(store, name)], name).id for name in ("a", "b"))
    assert calibrations.in_use() is None
    for identity, text in ((first, "{}"), (second, "[]")):
        finish(store, engine, identity, text)
        calibrations.mark_in_use(identity)
        assert [each.id for each in calibrations.find() if each.in_use] == [identity]


def test_a_failure_is_told_and_can_be_removed(calibrations: Calibrations, store: Store, engine: Engine) -> None:
    identity = calibrations.add_shots(BOARD, [board_shot(store, "one")], "").id
    engine.rows[identity].status = "MAX_RECOVERY_ATTEMPTS_EXCEEDED"
    found = calibrations.get(identity)
    assert found.state == "failed"
    assert found.error is not None
    assert found.error.type.endswith("worker-died")
    calibrations.remove(identity)
    assert engine.rows == {}
    for unknown in (identity, "no id", "../" + identity):
        with pytest.raises(NotFound):
            calibrations.get(unknown)


def test_what_was_accepted_but_not_queued_is_queued_when_it_is_asked_for(
    calibrations: Calibrations, store: Store, engine: Engine
) -> None:
    identity = calibrations.add_shots(BOARD, [board_shot(store, "one")], "").id
    engine.rows.clear()  # killed between the two
    assert calibrations.get(identity).state == "queued"
    assert set(engine.rows) == {identity}
    record = store.folder("calibrations", identity) / "record.json"
    assert json.loads(record.read_text())["id"] == identity
    record.write_text("{")
    with pytest.raises(NotFound):
        calibrations.get(identity)


def test_a_poor_one_is_not_put_to_use_unasked_and_a_running_one_tells_its_progress(
    calibrations: Calibrations, store: Store, engine: Engine
) -> None:
    made = calibrations.add_shots(BOARD, [board_shot(store, "a")], "few")
    engine.rows[made.id].status = "PENDING"
    assert (calibrations.get(made.id).progress, calibrations.get(made.id).eta_s) == (0.0, None)
    event: EventDocument = {"state": "running", "stage": "bundle", "progress": 0.6, "eta_s": 12.5}
    calibrations._events.append(made.id, event)
    running = calibrations.get(made.id)
    assert (running.stage, running.progress, running.eta_s) == ("bundle", 0.6, 12.5)
    finish(store, engine, made.id)
    calibrations.check_usable(made.id)  # of a version that did not judge
    engine.rows[made.id].output |= {"verdict": "poor", "missing": ["cam03: fewer than 3 views of the board"]}
    with pytest.raises(Conflict, match="calibration is poor") as refused:
        calibrations.check_usable(made.id)
    assert texts_of(refused.value.errors) == ["cam03: fewer than 3 views of the board"]
    assert texts_of(calibrations.get(made.id).missing) == ["cam03: fewer than 3 views of the board"]
    calibrations.remove(made.id)
    assert calibrations._events.latest([made.id]) == {}
